"""A small system that can be asked and ordered, and notes each order that reaches it."""

from collections.abc import Iterator
from typing import Any

import pytest

from trade import Resource, service
from trade._container.system import System
from trade.testing import MemorySystem, memory_system
from trade_gateway.language import Dialogue, Lexicon, Memory, Model, read_lexicon
from trade_gateway.supervisor import ChildInfo, ChildServices

__all__ = ["Arm", "Eyes", "Planner", "World", "world"]


class Eyes:
    @service(effect="read", achieves=["see(?x)"])
    def check_for(self, what: str) -> bool:
        """Look for something in front of the robot."""
        return what == "cup"


class Arm:
    """An arm that moves as long as a test wants."""

    def __init__(self, resource: str, calls: list[str]) -> None:
        self.resources = (Resource(resource),)
        self._calls = calls

    @service
    def move(self, angle_rad: float) -> float:
        self._calls.append(f"{self.resources[0].name} moves {angle_rad}")
        return angle_rad

    @service(effect="stop")
    def stop(self) -> None:
        self._calls.append(f"{self.resources[0].name} stops")


class Planner:
    @service(effect="read")
    def plan(self) -> str:
        return "none"


class Supervised:
    """Stands for a supervisor: notes what it would restart."""

    certified = False

    def __init__(self, calls: list[str]) -> None:
        self._calls = calls

    def children(self) -> list[ChildInfo]:
        return [ChildInfo("camera-driver", "up", 1, 0, "")]

    def restart(self, name: str, who: str) -> bool:
        self._calls.append(f"restart {name}")
        return True


class World:
    """Two containers, base and rover, and one that asks. ``calls`` has what the orders did."""

    def __init__(self, memory: MemorySystem, monkeypatch: pytest.MonkeyPatch) -> None:
        self.memory = memory
        self.calls: list[str] = []
        self._note(monkeypatch, "set_discovery", "set_broadcast", "connect", "disconnect", "terminate_container")
        self.base = memory.container("base")
        self.rover = memory.container("rover", instantiable=[f"{__name__}:Planner"])
        self.spare = memory.container("spare", instantiable=[f"{__name__}:Planner"])
        self.base.register(Eyes(), "rosie.eyes")
        self.base.register(Arm("left", self.calls), "rosie.left.arm")
        self.base.register(Arm("right", self.calls), "rosie.right.arm")
        self.base.register(Arm("neck", self.calls), "rosie.head")
        children: Any = Supervised(self.calls)
        self.base.register_functions(ChildServices(children), "supervisor")
        self.rover.register(Planner(), "rosie.planner")
        self.asker = memory.container("asker", identity="olga")
        memory.settle()

    def talk(self, lexicon: Lexicon | None = None, *, keeps: bool = True, model: Model | None = None) -> Dialogue:
        return Dialogue(self.asker, lexicon or read_lexicon(), Memory(), keeps=keeps, model=model)

    def _note(self, monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
        """The transport in memory has no links to change, and the containers of a test end with it."""
        for name in names:

            def noted(system: System, *args: Any, _name: str = name, **kwargs: Any) -> list[str]:
                place = system._components().client.name
                self.calls.append(" ".join([place, _name, *map(str, args)]))
                return []

            monkeypatch.setattr(System, name, noted)

    @property
    def host(self) -> str:
        return self.base.containers()[0].host

    def planners(self) -> list[str]:
        self.memory.settle()
        return sorted(one.container for one in self.asker.services() if one.name == "plan")


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    with memory_system() as memory:
        yield World(memory, monkeypatch)
