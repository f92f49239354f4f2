"""Behind a hub, a container that begins announces all that it has, and no other has to query it."""

from collections import Counter
from collections.abc import Iterator

import pytest

from tests.unit.trade.lamp_provider import Lamp
from trade import where
from trade._discovery import resync
from trade._registry.revision_tracker import RevisionTracker
from trade.protocol.keys import TALLY
from trade.testing import MemorySystem, MessageKind, VirtualTime, memory_system
from trade.transport.memory import InFlightMessage, MemoryTransport

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def system() -> Iterator[MemorySystem]:
    with memory_system() as system:
        yield system


@pytest.fixture
def _behind_a_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MemoryTransport, "relayed", True)


@pytest.fixture
def _punctually() -> None:
    """Others query what has not introduced itself within moments."""
    if VirtualTime.current() is None:
        pytest.skip("it judges by moments: on the real clock, threads also wait for a processor")


class Queries:
    """The queries in a system, and how many one container had open at the same time."""

    def __init__(self, system: MemorySystem) -> None:
        self.of: list[tuple[str, str]] = []
        self.most = 0
        self._open = Counter[str]()
        system.tap(self._see)

    def _see(self, message: InFlightMessage) -> None:
        if message.arrived:
            return
        if message.kind is MessageKind.ASK:
            self.of.append((message.source, message.target))
            self._open[message.source] += 1
            self.most = max(self.most, self._open[message.source])
        elif message.kind is MessageKind.ANSWER and message.key.endswith(f"/{TALLY}"):
            self._open[message.target] -= 1

    def to(self, name: str) -> list[str]:
        return [asking for asking, asked in self.of if asked == name]


def all_know(system: MemorySystem, names: list[str]) -> bool:
    return all(len(system.container(name).services(where(name="dim"))) == len(names) for name in names)


def begin(system: MemorySystem, count: int) -> list[str]:
    names = [f"c{number}" for number in range(count)]
    for name in names:
        system.container(name).register(Lamp(), f"lamps.{name}")
        system.settle()
    return names


@pytest.mark.usefixtures("_behind_a_hub", "_punctually")
def test_a_container_that_begins_is_not_queried_and_queries_all_others(system: MemorySystem) -> None:
    queries = Queries(system)
    names = begin(system, 6)
    assert all_know(system, names)
    for number, name in enumerate(names):
        assert [asking for asking in queries.to(name) if int(asking[1:]) < number] == []
        assert sorted(asked for asking, asked in queries.of if asking == name) == names[:number]


def test_with_links_of_their_own_all_query_one_that_begins(system: MemorySystem) -> None:
    """The answer shows which link leads to it, and each of them passes it on itself."""
    queries = Queries(system)
    names = begin(system, 4)
    assert sorted(queries.to("c3")) == names[:3]


@pytest.mark.usefixtures("_behind_a_hub", "_punctually")
@pytest.mark.parametrize("lost", ["system", "tally"])
def test_one_that_missed_a_part_queries(system: MemorySystem, lost: str) -> None:
    names, queries = begin(system, 3), Queries(system)
    heal = system.lose(
        lambda message: (
            message.kind is MessageKind.ANNOUNCE and message.target == "c1" and message.key.endswith(f"/{lost}")
        )
    )
    system.container("late").register(Lamp(), "lamps.late")
    system.settle()
    heal()
    assert queries.to("late") == ["c1"]
    assert all_know(system, [*names, "late"])


@pytest.mark.usefixtures("_behind_a_hub")
def test_a_container_queries_few_at_the_same_time(system: MemorySystem) -> None:
    names, queries = begin(system, 24), Queries(system)
    system.container("late")
    system.settle()
    assert sorted(asked for asking, asked in queries.of if asking == "late") == sorted(names)
    assert 8 <= queries.most <= 16


def test_only_a_run_from_the_first_announcement_needs_no_answer() -> None:
    whole, late, gap = RevisionTracker(), RevisionTracker(), RevisionTracker()
    for revision in (1, 2, 3):
        whole.announced(revision)
    assert not whole.complete, "there may be more"
    whole.counted(3)
    late.announced(3)
    late.counted(3)
    for revision in (1, 3):
        gap.announced(revision)
    gap.counted(3)
    assert (whole.complete, late.complete, gap.complete) == (True, False, False)
    whole.announced(4)
    assert whole.complete
    whole.announced(6)
    assert not whole.complete


def test_what_opens_again_needs_an_answer_whatever_it_announced_before() -> None:
    tracker = RevisionTracker()
    for revision in (1, 2):
        tracker.announced(revision)
    tracker.counted(2)
    tracker.reopen()
    for revision in (3, 4):
        tracker.announced(revision)
    tracker.counted(4)
    assert not tracker.complete
    tracker.replied(4)
    assert tracker.complete


@pytest.mark.usefixtures("_behind_a_hub", "_punctually")
def test_what_was_withdrawn_before_the_introduction_leaves_a_gap_for_which_others_query(system: MemorySystem) -> None:
    lamp, reader = Lamp(), system.container("reader")
    queries = Queries(system)
    arm = system.container("arm")
    arm.register(lamp, "lamps.arm")
    arm.deregister(lamp)
    arm.register(Lamp(), "lamps.other")
    system.settle()
    assert queries.to("arm") == ["reader"]
    assert [handle.key.provider for handle in reader.services(where(name="dim"))] == ["Lamp-2"]


@pytest.mark.usefixtures("_behind_a_hub")
def test_a_system_has_settled_when_all_have_introduced_themselves(
    system: MemorySystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if others queried them before that, and what they register was not announced yet."""
    monkeypatch.setattr(resync, "_INTRODUCTION_S", 0.2)
    reader = system.container("reader")
    monkeypatch.setattr(reader._parts.transport, "relayed", False)  # it does not wait for introductions
    arm = system.container("arm")
    system.drive(lambda: not reader.catching_up)
    arm.register(Lamp(), "lamps.arm")
    assert reader.services(where(name="dim")) == []
    system.settle()
    assert len(reader.services(where(name="dim"))) == 1
