"""The ledger of one container's e-stops: open ones, cleared ones, and the state of requests; all of it is bounded."""

from collections.abc import Iterable, Sequence
from typing import Final, TypeVar

from msgspec import structs

from trade.protocol.keys import Address
from trade.protocol.messages import Estop

MOST_OF_ONE: Final = 16
"""The most open e-stops of one identity in a container. Beyond that, the newest replaces the one before it: the first
ones keep their reasons, and an e-stop after a person's last look is not cleared with the others."""
_MOST_REQUESTS: Final = 4096
_Value = TypeVar("_Value")


class Ledger:
    """The records of e-stops; its owner guards it with a lock.

    Args:
        estops: e-stops that are open from the start.
    """

    def __init__(self, estops: Iterable[Estop]) -> None:
        self.open: Final = {estop.id: estop for estop in estops}
        """The open e-stops, in the order of arrival."""
        self.cleared: Final[dict[str, None]] = {}
        """Cleared ids: late messages do not open these again."""
        self.replaced: list[str] = []
        """Ids that a newer e-stop has replaced; their files are removed once that one is written."""
        self._answers: dict[str, str | None] = dict.fromkeys(self.open, "")

    @property
    def first(self) -> Estop | None:
        """The oldest open e-stop."""
        return min(self.open.values(), key=age, default=None)

    def knows(self, request: str) -> bool:
        """Whether that was requested, or cleared, before."""
        return request in self._answers or request in self.cleared

    def answer(self, request: str) -> str | None:
        """The problem of an earlier request, or empty; None while it is not done."""
        return "" if request in self.cleared else self._answers[request]

    def answered(self, request: str, problem: str) -> None:
        """Records that a request is done."""
        self._answers[request] = problem

    def begin(self, request: str, opened: Estop | None) -> str:
        """Begins a request, and opens its e-stop. Returns the request that is forgotten for it, if any."""
        self._answers[request] = None
        if opened is not None:
            its = self._of(identity_of(opened))
            self.open[opened.id] = opened
            if len(its) >= MOST_OF_ONE:
                del self.open[its[-1].id]
                self.replaced.append(its[-1].id)
        return _without_the_oldest(self._answers)

    def update_report(self, given: Estop) -> None:
        """Takes the giver's own order after another container's report of it."""
        there = self.open.get(given.id)
        if there is not None and there.told_by and there.by == given.by:
            self.open[given.id] = given

    def wants(self, reported: Estop) -> bool:
        """Whether to open an e-stop that others have open: it is unknown, or was replaced for lack of room."""
        if reported.id in self.open or reported.id in self.cleared or self._answers.get(reported.id, "") is None:
            return False
        return len(self._of(identity_of(reported))) < MOST_OF_ONE

    def clear(self, ids: Sequence[str]) -> None:
        """Clears e-stops by their ids."""
        for estop_id in ids:
            self.open.pop(estop_id, None)
            self.cleared[estop_id] = None
            _without_the_oldest(self.cleared)

    def _of(self, identity: str) -> list[Estop]:
        return [estop for estop in self.open.values() if identity_of(estop) == identity]


def identity_of(estop: Estop) -> str:
    """The identity that is said to have given it."""
    return estop.by.partition("/")[0]


def as_reported(estops: Iterable[Estop], reporter: Address) -> list[Estop]:
    """The e-stops that a container reports, marked with that container unless it has the giver's identity."""
    return [
        structs.replace(estop, told_by="" if identity_of(estop) == reporter.identity else reporter.who)
        for estop in estops
    ]


def age(estop: Estop) -> tuple[float, str]:
    """The sort key of e-stops."""
    return estop.at, estop.id


def _without_the_oldest(known: dict[str, _Value]) -> str:
    """Forgets the oldest entry if there are too many; returns its id, or empty."""
    if len(known) <= _MOST_REQUESTS:
        return ""
    oldest = next(iter(known))
    del known[oldest]
    return oldest
