"""Stories of robots under drawn troubles keep the rules of motion, and the judge sees it where a product does not."""

import itertools
import math
import re
from collections.abc import Callable, Iterable, Sequence, Set
from typing import Any, NamedTuple

import pytest

from tests.endurance.explore._records import Drawn
from tests.endurance.explore._robots import KINDS
from tests.endurance.explore._story import draw, play
from tests.endurance.explore._troubles import TROUBLES
from trade._locks import remote_locks
from trade._resources.lock_table import LockTable
from trade._resources.resource import Resource
from trade.sharing._border import BorderDirection
from trade_drivers.bus.can import CanPort
from trade_hil_sim.cia402._node import Node

SEEDS = 50
FOUND = [149, 1299, 1463]
"""Stories that found a fault. 149: a wall clock that is set back, and a bus thread that waits for it. 1299: a driver
that stood still in a cycle took the motion of its joint meanwhile for a lost zero. 1463: a drive that failed before it
had taken its goal took no other one."""
_MUTANT_STORIES = 12
"""A mutant has to be seen in one of so many stories that it concerns."""


@pytest.mark.parametrize("seed", [*range(1, SEEDS + 1), *FOUND])
def test_motion_keeps_its_rules_whatever_happens(seed: int) -> None:
    assert play(seed).violations == []


def test_the_same_seed_gives_the_same_story() -> None:
    assert str(play(7)) == str(play(7))


def _no_stop_holds(patch: pytest.MonkeyPatch) -> None:
    def check(self: Resource, tokens: Iterable[Any], caller: str, session: str = "") -> None:
        self.check_lock(tokens, caller, session)

    patch.setattr(Resource, "check", check)


def _two_owners(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(LockTable, "_obstacle", lambda *_: None)


def _no_lease_ends(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(LockTable, "expire", lambda _: math.inf)
    patch.setattr(LockTable, "session_ended", lambda *_: None)


def _gateway_forgets_locks(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(remote_locks, "_by_system", lambda _: {})


def _gateway_drops_estops(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(BorderDirection, "_estop", lambda *_: "")


def _drives_need_no_heartbeat(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Node, "_hear_heartbeat", lambda *_: None)


class _ByWallClock:
    """A bus whose frames are waited for with python-can's own receive."""

    def __init__(self, bus: Any) -> None:
        self._bus = bus

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def _recv_internal(self, timeout_s: float) -> tuple[Any, bool]:
        return self._bus.recv(timeout_s), True


def _bus_waits_by_wall_clock(patch: pytest.MonkeyPatch) -> None:
    open_bus = CanPort._open_bus
    patch.setattr(CanPort, "_open_bus", lambda port: _ByWallClock(open_bus(port)))


class Concerned(NamedTuple):
    """The stories that a mutant concerns: who takes part, and one of the troubles."""

    troubles: Set[str] = frozenset(TROUBLES)
    robots: Set[str] = frozenset(KINDS)
    seeds: Iterable[int] = range(1, 2000)
    gateway: bool = False
    operator_beyond: bool = False

    def has(self, seed: int) -> bool:
        _, cast, troubles = draw(seed)
        who = cast.gateway >= self.gateway and cast.operator_beyond >= self.operator_beyond
        return who and {one.group for one in cast.robots} <= self.robots and bool(self._of(troubles))

    def _of(self, troubles: Sequence[Drawn]) -> Set[str]:
        return {one.name for one in troubles} & self.troubles


CAN = {"rosie.leg", "rosie.arm", "rosie.hand"}


@pytest.mark.parametrize(
    ("mutate", "says", "concerned"),
    [
        (_no_stop_holds, "stop was confirmed", Concerned({"stop", "estop"})),
        (_no_stop_holds, "(leg|arm|hand) .*stop was confirmed", Concerned({"estop"}, CAN)),
        (_two_owners, "and (worker|planner) held", Concerned()),
        (_no_lease_ends, "still has", Concerned({"kill"})),
        (_gateway_forgets_locks, "and (worker|planner) held", Concerned(gateway=True)),
        (_gateway_drops_estops, "stop was confirmed", Concerned({"estop"}, operator_beyond=True)),
        (_drives_need_no_heartbeat, "longer than", Concerned(seeds=[420])),  # a slow move, and no cable
        (_bus_waits_by_wall_clock, "cannot be used at the end", Concerned(seeds=[149])),
    ],
)
def test_the_judge_sees_what_is_wrong(
    mutate: Callable[[pytest.MonkeyPatch], None], says: str, concerned: Concerned, monkeypatch: pytest.MonkeyPatch
) -> None:
    mutate(monkeypatch)
    seeds = itertools.islice(filter(concerned.has, concerned.seeds), _MUTANT_STORIES)
    assert any(re.search(says, "\n".join(play(seed).violations)) for seed in seeds)
