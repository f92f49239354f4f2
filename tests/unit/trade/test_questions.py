"""What one would ask a system in a dialogue, answered by the calls that the dialogue would make."""

import queue
from collections.abc import Iterator
from typing import Annotated

import pytest

from trade import Container, Handle, Meta, service, where
from trade.testing import MemorySystem, memory_system

pytestmark = pytest.mark.virtual_time


class Eyes:
    @service(effect="read", achieves=["see(cup)"])
    def check_for(self, what: str) -> bool:
        """Look for something in front of the robot."""
        return what == "cup"


class Head:
    @service
    def turn(self, angle_rad: Annotated[float, Meta(ge=-1.4, le=1.4)]) -> None:
        """Turn left or right."""


class News:
    """What has happened since the last question."""

    def __init__(self) -> None:
        self.reported: queue.SimpleQueue[str] = queue.SimpleQueue()

    @service
    def came(self, what: Handle) -> None:
        self.reported.put(f"new: {what.label} in {what.container}")

    @service
    def went(self, what: Handle) -> None:
        self.reported.put(f"gone: {what.label}")

    @service
    def is_other(self, what: Handle) -> None:
        self.reported.put(f"changed: {what.label}: {what.health}")


@pytest.fixture
def memory() -> Iterator[MemorySystem]:
    with memory_system() as system:
        system.container("robot").register(Eyes(), "rosie.eyes")
        system.settle()
        yield system


def test_questions_of_what_exists_who_can_do_it_and_where_are_answered_by_calls(memory: MemorySystem) -> None:
    """'Which computers are there, what can they do, how do I ask for it, and who can see a cup?'"""
    asker = memory.container("asker")
    memory.settle()
    known = asker.call(where(name="containers", group="trade", container="robot"))
    assert {info.name for info in known} == {"robot", "asker"}
    robot = next(info for info in known if info.name == "robot")
    assert robot.host
    assert robot.services > 0
    [offered] = asker.services(where(group="rosie"))
    assert (offered.label, offered.container, offered.host) == ("rosie.eyes.check_for", "robot", robot.host)
    assert offered.signature == "check_for(what: str) -> bool"
    assert offered.doc == "Look for something in front of the robot."
    assert asker.find(where(achieves="see(?x)")) == offered
    assert asker.call(where(name="load", group="trade", container="robot")).container == "robot"


def test_what_is_new_is_answered_by_notifications(memory: MemorySystem) -> None:
    """'Tell me when something comes, goes, or is not well any more.'"""
    asker: Container = memory.container("asker")
    news, robot = News(), memory.container("robot")
    came, went, is_other = asker.register(news, "asker.news")
    memory.settle()
    rosie = where(group="rosie")
    for occasion, call in ((asker.joined, came), (asker.left, went), (asker.changed, is_other)):
        occasion(rosie, call=call)
    head = Head()
    robot.register(head, "rosie.head")
    memory.settle()
    assert news.reported.get(timeout=20) == "new: rosie.head.turn in robot"
    robot.set_health(head, "degraded: overheating")
    memory.settle()
    assert news.reported.get(timeout=20) == "changed: rosie.head.turn: degraded: overheating"
    robot.deregister(head)
    memory.settle()
    assert news.reported.get(timeout=20) == "gone: rosie.head.turn"
    assert news.reported.empty()  # what was there before is not new
