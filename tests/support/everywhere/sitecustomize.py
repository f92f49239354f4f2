"""Breaks the product in each process that a test starts, as `tests.support.mutants` does in that of the test.

`tests.support.test_mutants` puts this folder on the path. Python imports the module at each start.
"""

import os
import sys

if "MUTANT" in os.environ and "pytest" not in sys.orig_argv:
    from tests.support.mutants import HOW

    HOW[os.environ["MUTANT"]](setattr)
