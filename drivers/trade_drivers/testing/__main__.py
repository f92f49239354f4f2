"""``python -m trade_drivers.testing --hil ROBOT.toml``."""

import sys

try:
    from trade_drivers.testing._hil import main
except ImportError as missing:
    sys.exit(f"the contracts are run by pytest ({missing}); pip install pytest")

sys.exit(main())
