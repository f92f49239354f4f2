"""``trade conformance``: a container in whatever language is started, and seen from outside to keep the rules."""

from trade_gateway.conformance import (
    _being_there,
    _calling,
    _moving,
    _locking,
    _asking,
    _estopping,
)
from trade_gateway.conformance._check import CHECKS, Check
from trade_gateway.conformance._run import FAILED, LEFT_OUT, OK, Outcome, run

__all__ = ["CHECKS", "FAILED", "LEFT_OUT", "OK", "Check", "Outcome", "run"]
