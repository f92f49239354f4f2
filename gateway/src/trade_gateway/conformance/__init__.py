"""``trade conformance``: a container in whatever language is started, and seen from outside to keep the rules."""

from trade_gateway.conformance._check import Check
from trade_gateway.conformance._run import CHECKS, FAILED, LEFT_OUT, OK, Outcome, run

__all__ = ["CHECKS", "FAILED", "LEFT_OUT", "OK", "Check", "Outcome", "run"]
