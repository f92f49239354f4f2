"""``trade conformance``: a container in whatever language is started, and seen from outside to keep the rules."""

from trade_gateway.conformance._check import Check
from trade_gateway.conformance._run import FAILED, LEFT_OUT, OK, Outcome, run
from trade_gateway.conformance._table import CHECKS

__all__ = ["CHECKS", "FAILED", "LEFT_OUT", "OK", "Check", "Outcome", "run"]
