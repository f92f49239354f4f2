"""Which e-stops are open in one container, which were cleared, and how far what was asked is; all of it is bounded."""

from collections.abc import Iterable, Sequence
from typing import Final, TypeVar

from msgspec import structs

from trade._protocol.keys import Address
from trade._protocol.messages import Estop

MOST_OF_ONE: Final = 16
"""So many e-stops of one identity are open in a container. From then on the newest takes the place of the one before:
the first ones keep their reasons, and none that comes after somebody has looked is cleared with them."""
_MOST_REQUESTS: Final = 4096
_Value = TypeVar("_Value")


class Ledger:
    """Its owner has the lock.

    Args:
        estops: those that are open from the start.
    """

    def __init__(self, estops: Iterable[Estop]) -> None:
        self.open: Final = {estop.id: estop for estop in estops}
        """In the order in which they came."""
        self.cleared: Final[dict[str, None]] = {}
        """What still travels of these opens nothing again."""
        self.replaced: list[str] = []
        """Ids whose place a newer one has taken; their notes go once that one is written."""
        self._answers: dict[str, str | None] = dict.fromkeys(self.open, "")

    @property
    def first(self) -> Estop | None:
        """The oldest that is open."""
        return min(self.open.values(), key=age, default=None)

    def knows(self, request: str) -> bool:
        """Whether that was asked, or cleared, before."""
        return request in self._answers or request in self.cleared

    def answer(self, request: str) -> str | None:
        """What failed of what was asked before; None: it is not done yet."""
        return "" if request in self.cleared else self._answers[request]

    def answered(self, request: str, problem: str) -> None:
        """It is done."""
        self._answers[request] = problem

    def begin(self, request: str, opened: Estop | None) -> str:
        """What is asked is not done yet, and what it opens is open. The request that is forgotten for it, if any."""
        self._answers[request] = None
        if opened is not None:
            its = self._of(identity_of(opened))
            self.open[opened.id] = opened
            if len(its) >= MOST_OF_ONE:
                del self.open[its[-1].id]
                self.replaced.append(its[-1].id)
        return _without_the_oldest(self._answers)

    def hear(self, given: Estop) -> None:
        """Its giver says so itself, after another one told of it."""
        there = self.open.get(given.id)
        if there is not None and there.told_by and there.by == given.by:
            self.open[given.id] = given

    def wants(self, told: Estop) -> bool:
        """Whether one that others have open is to be opened here: unknown, or replaced while there was no room."""
        if told.id in self.open or told.id in self.cleared or self._answers.get(told.id, "") is None:
            return False
        return len(self._of(identity_of(told))) < MOST_OF_ONE

    def clear(self, ids: Sequence[str]) -> None:
        """These are open no more."""
        for estop_id in ids:
            self.open.pop(estop_id, None)
            self.cleared[estop_id] = None
            _without_the_oldest(self.cleared)

    def _of(self, identity: str) -> list[Estop]:
        return [estop for estop in self.open.values() if identity_of(estop) == identity]


def identity_of(estop: Estop) -> str:
    """Who is said to have given it."""
    return estop.by.partition("/")[0]


def as_told(estops: Iterable[Estop], teller: Address) -> list[Estop]:
    """What a container tells of, with who told, unless that is of the identity that is said to have given it."""
    return [
        structs.replace(estop, told_by="" if identity_of(estop) == teller.identity else teller.who) for estop in estops
    ]


def age(estop: Estop) -> tuple[float, str]:
    """What e-stops are sorted by."""
    return estop.at, estop.id


def _without_the_oldest(known: dict[str, _Value]) -> str:
    """Forget the one that came first if there are too many; which."""
    if len(known) <= _MOST_REQUESTS:
        return ""
    oldest = next(iter(known))
    del known[oldest]
    return oldest
