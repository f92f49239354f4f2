"""One check: what is asked of a container, where that is said, and how it is found out."""

from collections.abc import Callable

from msgspec import Struct

from trade_gateway.conformance._environment import Stage


class Check(Struct, frozen=True):
    """A rule and how to see whether it is held."""

    name: str
    what: str
    rule: str
    """Of the safety rules (docs/safety.md), or the section of the wire protocol's page."""
    does: Callable[[Stage], None]
    still: bool = False
    """Whether it asks nothing of what moves; the others turn the arm, or fail where there is none."""
    needs: str = ""
    """A function of the container's own provider, without which the check is left out."""


def check(name: str, rule: str, *, still: bool = False, needs: str = "") -> Callable[[Callable[[Stage], None]], Check]:
    """Make a check of a function; what it asks is the first line of its docstring."""

    def make(does: Callable[[Stage], None]) -> Check:
        what = (does.__doc__ or "").strip().splitlines()[0].rstrip(".")
        return Check(name, what, rule, does, still, needs)

    return make
