"""``python -m trade_gateway`` is the command ``trade``."""

from trade_gateway.cli import main

main()
