"""The description of one check: its rule, the source of that rule, and its function."""

from collections.abc import Callable

from msgspec import Struct

from trade_checks.conformance._environment import Stage


class Check(Struct, frozen=True):
    """A rule and the function that checks it."""

    name: str
    what: str
    rule: str
    """A safety rule (docs/safety.md), or a section of the wire protocol's page."""
    does: Callable[[Stage], None]
    still: bool = False
    """Whether the check needs no motion; the others turn the arm, and fail without one."""
    needs: str = ""
    """A function of the container's own provider, without which the check is skipped."""


def check(name: str, rule: str, *, still: bool = False, needs: str = "") -> Callable[[Callable[[Stage], None]], Check]:
    """Turns a function into a check; the first line of its docstring is the requirement."""

    def make(does: Callable[[Stage], None]) -> Check:
        what = (does.__doc__ or "").strip().splitlines()[0].rstrip(".")
        return Check(name, what, rule, does, still, needs)

    return make
