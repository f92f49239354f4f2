"""What `trade watch` makes of a system, look by look."""

import threading
from collections.abc import Iterator

import pytest

from trade import Resource, service, where
from trade._locks import api
from trade.testing import MemorySystem, memory_system
from trade_gateway.cli.watching import _watch
from trade_gateway.cli.watching._watch import WatchedSystem

pytestmark = pytest.mark.virtual_time


class Arm:
    def __init__(self) -> None:
        self.resources = [Resource("rosie.arm")]

    @service
    def reach(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def system() -> Iterator[MemorySystem]:
    with memory_system() as made:
        yield made


def test_who_does_not_answer_has_not_given_its_locks_back(
    system: MemorySystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, planner, looker = (system.container(name) for name in ("robot", "planner", "looker"))
    robot.register(Arm(), "rosie.arm")
    system.settle()
    monkeypatch.setattr(api, "_ANSWER_S", 0.2)
    monkeypatch.setattr(_watch, "_ASKED_EVERY_S", 0.0)
    seen = WatchedSystem(looker, where(group="rosie"))

    def news() -> list[str]:
        return [one.what for one in seen.news()]

    asleep = threading.Event()
    with planner.lock(where(group="rosie")):
        assert news() == ["locked"]
        with monkeypatch.context() as patch:
            patch.setattr(robot._parts.locks, "infos", lambda: asleep.wait(60) and [])
            assert news() == []
            asleep.set()
        assert news() == []
    assert news() == ["released"]
