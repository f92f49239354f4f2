"""``python -m trade_drivers.testing --hil ROBOT.toml``."""

import sys

from trade_drivers.testing._hil import main

sys.exit(main())
