"""``trade conformance``: starts a container in any language and checks from outside that it follows the rules."""

from trade_checks.conformance._check import Check
from trade_checks.conformance._run import CHECKS, Outcome, Result, run

__all__ = ["CHECKS", "Check", "Outcome", "Result", "run"]
