"""A driver broken on purpose, in one way of `mutants`: ``broken_driver.py HOW COMMAND...``; the siege must find it."""

import sys

from tests.support.mutants import HOW
from trade_gateway.cli import main

if __name__ == "__main__":
    HOW[sys.argv.pop(1)](setattr)
    main()
