"""One check: what is asked of a container, where that is said, and how it is found out."""

from collections.abc import Callable
from typing import Final

from msgspec import Struct

from trade_gateway.conformance._stage import Stage


class Check(Struct, frozen=True):
    """A rule and how to see whether it is held."""

    name: str
    what: str
    rule: str
    """Of the safety rules (docs/safety.md), or the section of the wire protocol's page."""
    does: Callable[[Stage], None]
    needs: str = ""
    """A function of the container's own provider, without which the check is left out."""


CHECKS: Final[list[Check]] = []
"""All of them, in the order they are made."""


def check(name: str, rule: str, *, needs: str = "") -> Callable[[Callable[[Stage], None]], Callable[[Stage], None]]:
    """Put a function into the table; what it asks is the first line of its docstring."""

    def put(does: Callable[[Stage], None]) -> Callable[[Stage], None]:
        what = (does.__doc__ or "").strip().splitlines()[0].rstrip(".")
        CHECKS.append(Check(name, what, rule, does, needs))
        return does

    return put
