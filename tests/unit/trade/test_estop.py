"""S09: one e-stop for the whole system, with messages lost, drivers restarted, and ids cleared."""

import os
import random
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.support.waiting import wait_until
from trade import Container, Estop, EstopReport, Resource, current_call, service, where
from trade._audit.events import Event
from trade._estop.ledger import MOST_OF_ONE
from trade._estop.worker import SHARED_S, Worker
from trade._threads.channel_workers import MOST_THREADS
from trade.errors import Busy, ConfigurationError, MotionStopped, NoSuchEstop, Stopped
from trade.protocol.estop_messages import decode_estop_confirmed, decode_estop_order
from trade.protocol.keys import Address, alive_key, registry_key
from trade.protocol.messages import PROTOCOL, EstopOrder, ProviderInfo, ServiceInfo, encode_message
from trade.testing import MemorySystem, MessageKind, memory_system
from trade.transport.memory import InFlightMessage, MemoryTransport

pytestmark = pytest.mark.virtual_time

Eventually = Callable[[Callable[[], bool]], bool]
GENEROUS_S = 30.0


class Axis:
    """One joint that moves until it is stopped."""

    def __init__(self, name: str, *, stops: bool = True, failing: bool = False) -> None:
        self.joint = Resource(name)
        self.resources = [self.joint]
        self.stopped = 0
        self.written: list[float] = []
        self.begun = threading.Event()
        self._stops = stops
        self._failing = failing

    @service
    def move_to(self, goal: float) -> float:
        self.written.append(goal)
        return goal

    @service
    def run(self) -> str:
        """Move on and on; what stopped it."""
        call = current_call()
        assert call is not None
        assert call.permit is not None
        self.joint.moving = True
        self.begun.set()
        call.wait_cancelled(GENEROUS_S)
        try:
            call.permit.gate()
        except MotionStopped as stopped:
            return str(stopped)
        return "not stopped"

    @service(effect="read")
    def position(self) -> float:
        return self.written[-1] if self.written else 0.0

    @service(effect="stop")
    def stop(self) -> None:
        self.stopped += 1
        if self._failing:
            raise OSError("the cable is off")
        if self._stops:
            self.joint.moving = False


class Bare:
    """Something with a stop and no resources."""

    def __init__(self) -> None:
        self.stopped = 0

    @service
    def go(self) -> None: ...

    @service(effect="stop")
    def halt(self) -> None:
        self.stopped += 1


def call(container: Container, name: str, group: str, *arguments: object) -> object:
    return container.find(where(name=name, group=group), wait_s=20).with_(deadline_s=20)(*arguments)


@pytest.fixture
def system(tmp_path: Path) -> Iterator[MemorySystem]:
    with memory_system(state_dir=tmp_path / "state") as made:
        yield made


def drivers(system: MemorySystem, *names: str) -> list[Axis]:
    axes = [Axis(f"{name}.joint") for name in names]
    for name, axis in zip(names, axes, strict=True):
        system.container(name).register(axis, name)
    return axes


def test_S09_every_driver_stops_latches_and_confirms(system: MemorySystem) -> None:
    one, other = drivers(system, "one", "other")
    caller = system.container("caller")
    report = caller.estop("smoke", limit_s=GENEROUS_S)
    assert report == EstopReport(id=report.id, confirmed=("tester/one", "tester/other"))
    assert report.complete
    assert (one.stopped, other.stopped) == (1, 1)
    for name in ("one", "other"):
        with pytest.raises(Stopped, match="smoke") as refused:
            call(caller, "move_to", name, 0.5)
        assert refused.value.estop
        assert call(caller, "position", name) == 0.0
    assert [estop.reason for estop in system.container("one").estops()] == ["smoke"]


def test_S09_estops_are_services_of_every_container(system: MemorySystem) -> None:
    """So that a program that only speaks the wire protocol can give one."""
    [axis] = drivers(system, "one")
    caller = system.container("caller")

    def own(name: str, *arguments: object) -> object:
        found = caller.find(where(name=name, group="trade", container="one"), wait_s=20)
        return found.with_(deadline_s=GENEROUS_S)(*arguments)

    report = own("estop", "smoke")
    assert report.complete  # type: ignore[attr-defined]
    assert axis.stopped == 1
    [open_] = own("estops")  # type: ignore[misc]
    assert open_.reason == "smoke (asked by tester)"
    with pytest.raises(NoSuchEstop):
        own("estop_clear", ["nonsense"])
    assert own("estop_clear", [open_.id]).complete  # type: ignore[attr-defined]
    assert call(caller, "move_to", "one", 0.5) == 0.5


def test_S09_a_motion_under_way_is_stopped_and_what_was_admitted_is_void(system: MemorySystem) -> None:
    [axis] = drivers(system, "one")
    caller = system.container("caller")
    run = caller.find(where(name="run"), wait_s=20).with_(deadline_s=GENEROUS_S).start()
    assert axis.begun.wait(GENEROUS_S)
    system.container("other").estop(limit_s=GENEROUS_S)
    assert "e-stop" in str(run.result(GENEROUS_S))
    assert not axis.joint.moving


def test_S09_a_device_that_fails_to_stop_is_reported(system: MemorySystem) -> None:
    system.container("bad").register(Axis("bad.joint", failing=True), "bad")
    drivers(system, "good")
    report = system.container("caller").estop(limit_s=GENEROUS_S)
    assert report.confirmed == ("tester/good",)
    assert "the cable is off" in report.failed["tester/bad"]
    assert not report.complete


def test_S09_a_device_still_moving_after_its_stop_is_reported(system: MemorySystem) -> None:
    axis = Axis("heavy.joint", stops=False)
    system.container("heavy").register(axis, "heavy")
    axis.joint.moving = True
    report = system.container("caller").estop(limit_s=GENEROUS_S)
    assert report.failed == {"tester/heavy": "heavy.joint still moves"}


def test_S09_a_stop_that_names_no_resources_is_called_too(system: MemorySystem) -> None:
    bare = Bare()
    system.container("bare").register(bare, "bare")
    caller = system.container("caller")
    assert caller.estop(limit_s=GENEROUS_S).confirmed == ("tester/bare",)
    assert bare.stopped == 1
    with pytest.raises(Stopped):
        call(caller, "go", "bare")


def test_S09_the_callers_own_container_stops_too() -> None:
    with memory_system() as system:
        [axis] = drivers(system, "alone")
        assert system.container("alone").estop(limit_s=GENEROUS_S).confirmed == ("tester/alone",)
        assert axis.stopped == 1


def test_S09_an_estop_without_a_driver_is_incomplete_and_repeated_until_its_limit(system: MemorySystem) -> None:
    system.container("planner")
    report = system.container("caller").estop(limit_s=0.35)
    assert (report.confirmed, report.missing, report.complete) == ((), (), False)
    assert system.sent(MessageKind.DROPPABLE) >= 3


@pytest.mark.parametrize("seed", range(3))
def test_S09_it_is_repeated_until_it_gets_through_a_network_that_loses_most(seed: int) -> None:
    with memory_system(seed=seed) as system:
        axes = drivers(system, "one", "two", "three")
        caller = system.container("caller")
        draw = random.Random(seed)
        system.lose(lambda passage: passage.kind is MessageKind.DROPPABLE and draw.random() < 0.6)
        report = caller.estop(limit_s=GENEROUS_S)
        assert report.complete
        assert report.confirmed == ("tester/one", "tester/three", "tester/two")
        assert [axis.stopped for axis in axes] == [1, 1, 1]
        cleared = caller.estop_clear([report.id], limit_s=GENEROUS_S)
        assert cleared.complete
        assert caller.estops() == []


def test_S09_an_unreachable_container_is_missing_and_latches_once_it_is_back(
    system: MemorySystem, eventually: Eventually
) -> None:
    away, _ = drivers(system, "away", "near")
    caller = system.container("caller")
    system.settle()  # a query of a container that still joins would cross the cut
    for other in ("caller", "near"):
        system.partition("away", other)
    report = caller.estop(limit_s=3)
    assert (report.confirmed, report.missing) == (("tester/near",), ("tester/away",))
    assert away.stopped == 0
    system.advance(2)
    system.heal()
    system.settle()
    assert eventually(lambda: away.stopped == 1)
    with pytest.raises(Stopped):
        call(caller, "move_to", "away", 0.5)


def test_S09_a_late_joiner_takes_the_union(system: MemorySystem) -> None:
    drivers(system, "one")
    caller = system.container("caller")
    ids = {caller.estop(reason, limit_s=GENEROUS_S).id for reason in ("first", "second")}
    late = system.container("late")
    late.register(Axis("late.joint"), "late")
    assert {estop.id for estop in late.estops()} == ids
    with pytest.raises(Stopped, match="first"):
        call(late, "move_to", "late", 0.1)


def test_S09_a_driver_restarted_while_one_is_open_stays_latched(tmp_path: Path) -> None:
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, "one")
        report = system.container("one").estop("spill", limit_s=GENEROUS_S)
    with memory_system(state_dir=tmp_path) as system:  # all containers were gone
        drivers(system, "one")
        with pytest.raises(Stopped, match="spill"):
            call(system.container("one"), "move_to", "one", 0.1)
        assert system.container("one").estop_clear([report.id], limit_s=GENEROUS_S).complete
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, "one")
        assert call(system.container("one"), "move_to", "one", 0.1) == 0.1


@pytest.mark.parametrize("text", [b"half of", b'["abc", "\xbb", "", 0.0]'], ids=["broken off", "no text"])
def test_S09_an_unreadable_estop_note_counts_as_open(tmp_path: Path, text: bytes) -> None:
    folder = tmp_path / "memory" / "estop"
    folder.mkdir(parents=True)
    (folder / "abc.json").write_bytes(text)
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, "one")
        [estop] = system.container("one").estops()
        assert estop.id == "abc"
        assert "cannot be read" in estop.reason


def test_S09_a_container_that_is_down_during_a_clearing_is_latched_when_it_starts_again(tmp_path: Path) -> None:
    """Others of its host heard the clearing; its own note is its own."""
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, "one", "other")
        other = system.container("other")
        report = other.estop("spill", limit_s=GENEROUS_S)
        system.container("one").close()
        system.settle()  # until the other one knows
        assert other.estop_clear([report.id], limit_s=GENEROUS_S).complete
        assert call(other, "move_to", "other", 0.1) == 0.1
        drivers(system, "one")
        with pytest.raises(Stopped, match="spill"):
            call(other, "move_to", "one", 0.1)
        assert other.estop_clear([report.id], limit_s=GENEROUS_S).complete
        system.container("one").close()
        drivers(system, "one")
        assert call(other, "move_to", "one", 0.1) == 0.1


def test_S09_a_program_without_a_name_of_its_own_finds_its_notes_under_another_process_id(tmp_path: Path) -> None:
    program = f"steering-{os.getpid()}"
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, program)
        system.container(program).estop("spill", limit_s=GENEROUS_S)
    assert [path.parent.name for path in tmp_path.rglob("*.json")] == ["steering"]


def test_S09_estop_files_of_the_previous_release_latch_every_container_until_cleared(tmp_path: Path) -> None:
    """It kept one folder for all containers of a host."""
    folder = tmp_path / "memory" / "estop"
    folder.mkdir(parents=True)
    (folder / "abc.json").write_text('["abc", "anna/desk/e1", "spill", 1.5]')
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, "one", "two")
        for name in ("one", "two"):
            with pytest.raises(Stopped, match="spill"):
                call(system.container("one"), "move_to", name, 0.1)
        system.container("two").close()
        system.settle()
        assert system.container("one").estop_clear(["abc"], limit_s=GENEROUS_S).complete
        drivers(system, "three")
        assert call(system.container("one"), "move_to", "three", 0.1) == 0.1
        drivers(system, "two")
        with pytest.raises(Stopped, match="spill"):
            call(system.container("one"), "move_to", "two", 0.1)


def test_S09_a_container_that_cannot_write_the_estop_to_disk_stops_and_says_so(tmp_path: Path) -> None:
    (tmp_path / "memory").write_text("a file where a folder should be")
    with memory_system(state_dir=tmp_path) as system:
        [axis] = drivers(system, "one")
        report = system.container("one").estop(limit_s=GENEROUS_S)
        assert "not written down" in report.failed["tester/one"]
        assert axis.stopped == 1


def test_S09_an_estop_that_could_not_be_written_is_written_once_the_disk_accepts_it(tmp_path: Path) -> None:
    blocked = tmp_path / "memory"
    blocked.write_text("a file where a folder should be")
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, "one")
        one = system.container("one")
        cleared, kept = (one.estop(reason, limit_s=GENEROUS_S) for reason in ("dust", "spill"))
        assert "not written down" in kept.failed["tester/one"]
        one.estop_clear([cleared.id], limit_s=GENEROUS_S)
        blocked.unlink()
        wait_until(lambda: [*tmp_path.rglob("*.json")])
        assert [note.stem for note in tmp_path.rglob("*.json")] == [kept.id]
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, "one")
        with pytest.raises(Stopped, match="spill"):
            call(system.container("one"), "move_to", "one", 0.1)


def test_S09_a_container_with_nothing_to_stop_writes_nothing(tmp_path: Path) -> None:
    with memory_system(state_dir=tmp_path) as system:
        system.container("caller").estop(limit_s=0.2)
        assert list(tmp_path.rglob("*.json")) == []
        drivers(system, "caller")  # has something from now on
        assert len(list(tmp_path.rglob("*.json"))) == 1


def test_S09_two_open_estops_are_cleared_one_by_one(system: MemorySystem) -> None:
    drivers(system, "one", "two")
    reports: list[EstopReport] = []

    def estop(name: str) -> None:
        reports.append(system.container(name).estop(name, limit_s=GENEROUS_S))

    threads = [threading.Thread(target=estop, args=(name,)) for name in ("one", "two")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(GENEROUS_S)
    caller = system.container("caller")
    first, second = reports
    assert first.complete
    assert second.complete
    assert caller.estop_clear([first.id], limit_s=GENEROUS_S).complete
    with pytest.raises(Stopped):
        call(caller, "move_to", "one", 0.1)
    assert caller.estop_clear([second.id], limit_s=GENEROUS_S).complete
    assert call(caller, "move_to", "one", 0.1) == 0.1


def ordered(system: MemorySystem, identity: str, number: int) -> list[str]:
    """Orders to stop, of an identity without a container; their ids."""
    puts = MemoryTransport(system.network, f"raw-{identity}").publish(f"estop/{identity}")
    ids = [f"{identity}-{count}" for count in range(number)]
    for name in ids:
        puts.put(encode_message(EstopOrder(PROTOCOL, name, Estop(name, f"{identity}/x/e", "", 0.0))))
    return ids


def test_S09_however_many_are_open_all_are_cleared_at_once(tmp_path: Path, eventually: Eventually) -> None:
    with memory_system(state_dir=tmp_path) as system:
        drivers(system, "one", "other")
        caller = system.container("caller")
        for identity in "abcdefgh":
            ordered(system, identity, 10)
        for container in (caller, system.container("one"), system.container("other")):
            assert eventually(lambda container=container: len(container.estops()) == 80)
        assert eventually(lambda: len(list(tmp_path.rglob("*.json"))) == 2 * 80)
        report = caller.estop_clear([estop.id for estop in caller.estops()], limit_s=GENEROUS_S)
        assert report.complete, report
        assert len(report.id.split(",")) == 80
        assert caller.estops() == []
        assert not list(tmp_path.rglob("*.json"))
        assert call(caller, "move_to", "one", 0.1) == 0.1


def test_S09_one_identity_holds_a_bounded_number_and_each_of_its_orders_stops_and_is_confirmed(
    tmp_path: Path, eventually: Eventually
) -> None:
    number = 500
    with memory_system(state_dir=tmp_path) as system:
        [axis] = drivers(system, "one")
        one, caller, confirmed = system.container("one"), system.container("caller"), set[str]()

        def hear(passage: InFlightMessage) -> None:
            if passage.key.startswith("estop/tester/one/"):
                confirmed.add(decode_estop_confirmed(passage.payload or b"").request)

        system.tap(hear)
        threads = threading.active_count()
        ids = ordered(system, "mallory", number)
        more = threading.active_count() - threads
        assert eventually(lambda: confirmed >= set(ids))
        assert more < 12
        kept = [*ids[: MOST_OF_ONE - 1], ids[-1]]  # the first ones, and the one that no reader can have seen
        opened = {estop.id for estop in one.estops()}
        assert opened >= set(kept)
        assert len(opened) <= 2 * MOST_OF_ONE  # those of `caller`, which may have learnt of others, are in it
        assert eventually(lambda: sorted(path.stem for path in tmp_path.rglob("*.json")) == sorted(kept))
        stopped = axis.stopped
        report = caller.estop("of another client", limit_s=GENEROUS_S)
        assert report.complete
        assert axis.stopped >= stopped
        assert caller.estop_clear([*opened], limit_s=GENEROUS_S).complete
        with pytest.raises(Stopped, match="of another client"):
            call(caller, "move_to", "one", 0.1)
        assert caller.estop_clear([report.id], limit_s=GENEROUS_S).complete
        assert call(caller, "move_to", "one", 0.1) == 0.1


def test_S09_an_evicted_estop_stays_open_while_another_container_has_it_open(
    system: MemorySystem, eventually: Eventually
) -> None:
    drivers(system, "one", "other")
    one, other = system.container("one"), system.container("other")
    ids = ordered(system, "mallory", MOST_OF_ONE)
    assert eventually(lambda: len(other.estops()) == MOST_OF_ONE)
    puts = MemoryTransport(system.network, "raw-mallory-2").publish("estop/mallory")
    system.lose(lambda passage: passage.source == "raw-mallory-2" and passage.target == "other")
    puts.put(encode_message(EstopOrder(PROTOCOL, "newest", Estop("newest", "mallory/x/e", "", 0.0))))
    assert eventually(lambda: one._parts.estop._estops.is_open("newest"))
    assert ids[-1] not in {estop.id for estop in one._parts.estop.open_here()}
    assert one.estop_clear([*ids[:-1], "newest"], limit_s=GENEROUS_S).complete
    assert eventually(lambda: ids[-1] in {estop.id for estop in one._parts.estop.open_here()})
    assert one.estop_clear([ids[-1]], limit_s=GENEROUS_S).complete
    assert one.estops() == []


def test_S09_a_second_e_stop_while_the_first_one_is_open_calls_the_stops_again(system: MemorySystem) -> None:
    """What could not be stopped is tried again by who presses again."""
    [axis] = drivers(system, "one")
    caller = system.container("caller")
    ids = [caller.estop(limit_s=GENEROUS_S).id]
    threading.Event().wait(2 * SHARED_S)
    ids.append(caller.estop(limit_s=GENEROUS_S).id)
    assert axis.stopped == 2
    assert caller.estop_clear(ids, limit_s=GENEROUS_S).complete
    assert caller.estop(limit_s=GENEROUS_S).complete  # at once, and what had no latch in between is stopped again
    assert axis.stopped == 3


def test_S09_clearing_an_unknown_estop_fails_and_lists_the_open_ones(system: MemorySystem) -> None:
    drivers(system, "one")
    caller = system.container("caller")
    report = caller.estop(limit_s=GENEROUS_S)
    with pytest.raises(NoSuchEstop, match=f"no open e-stop nonsense. Open e-stops: {report.id}"):
        caller.estop_clear(["nonsense", report.id])
    with pytest.raises(Stopped):
        call(caller, "move_to", "one", 0.1)
    with pytest.raises(ConfigurationError, match="in a list"):
        caller.estop_clear(report.id)


def test_S09_each_container_that_had_it_open_confirms_the_clearing(
    system: MemorySystem, eventually: Eventually, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one with nothing to stop that clears it before the asking container looks again."""
    drivers(system, "one")
    caller, *_ = (system.container(name) for name in ("caller", "desk", "lamp"))
    controller = caller._parts.estop
    having = {f"tester/{name}" for name in ("caller", "desk", "lamp", "one")}

    def reporting() -> set[str]:
        return {address.who for address, estops in controller._reported() if estops}

    report = caller.estop(limit_s=GENEROUS_S)
    assert eventually(lambda: reporting() == having)
    put = controller._broadcast._orders.put

    def put_slowly(order: bytes) -> None:
        put(order)
        assert eventually(lambda: reporting() <= {"tester/caller"})

    monkeypatch.setattr(controller._broadcast, "_orders", Mock(put=put_slowly))
    assert set(caller.estop_clear([report.id], limit_s=GENEROUS_S).confirmed) == having


def test_S09_after_clearing_nothing_moves_by_itself(system: MemorySystem) -> None:
    [axis] = drivers(system, "one")
    mover, other = system.container("mover"), system.container("other")
    run = mover.find(where(name="run"), wait_s=20).with_(deadline_s=GENEROUS_S).start()
    assert axis.begun.wait(GENEROUS_S)
    other.estop_clear([other.estop("look", limit_s=GENEROUS_S).id], limit_s=GENEROUS_S)
    run.result(GENEROUS_S)
    assert not axis.joint.moving
    with pytest.raises(Stopped, match=r"That e-stop is cleared, but .* not resumed yet.* trade\.resume") as refused:
        call(mover, "move_to", "one", 0.1)
    assert (refused.value.estop, refused.value.cleared) == (False, True)
    mover.resume(where(group="one"))
    assert call(mover, "move_to", "one", 0.1) == 0.1


def test_S09_a_container_that_was_unreachable_during_clearing_needs_another_clearing(system: MemorySystem) -> None:
    away, _ = drivers(system, "away", "near")
    caller = system.container("caller")
    report = caller.estop(limit_s=GENEROUS_S)
    system.settle()  # a query of a container that still joins would cross the cut
    for other in ("caller", "near"):
        system.partition("away", other)
    assert caller.estop_clear([report.id], limit_s=0.5).missing == ("tester/away",)
    system.advance(2)
    system.heal()
    system.settle()
    assert call(caller, "move_to", "near", 0.1) == 0.1
    with pytest.raises(Stopped):
        call(caller, "move_to", "away", 0.1)
    assert [estop.id for estop in caller.estops()] == [report.id]
    assert caller.estop_clear([report.id], limit_s=GENEROUS_S).complete
    assert call(caller, "move_to", "away", 0.1) == 0.1
    assert away.written == [0.1]


MOST_BYTES_OF_ESTOPS = 3072
FORGED = Estop("abc", "mallory/x/e", "", 0.0)
BAD = {
    "garbage": ("estop/tester", b"\xc1"),
    "another's name": ("estop/tester", encode_message(EstopOrder(PROTOCOL, "abc", FORGED))),
    "another version's clearing": ("estop/mallory", encode_message(EstopOrder(PROTOCOL + 1, "abc", None, ("abc",)))),
    "another's name in another version": ("estop/tester", encode_message(EstopOrder(PROTOCOL + 1, "abc", FORGED))),
    "another request": ("estop/mallory", encode_message(EstopOrder(PROTOCOL, "abcd", FORGED))),
    "a path": ("estop/mallory", encode_message(EstopOrder(PROTOCOL, "../a", Estop("../a", "mallory/x/e", "", 0.0)))),
    "a path to clear": ("estop/mallory", encode_message(EstopOrder(PROTOCOL, "abc", None, ("../a",)))),
    "garbage of a confirmation": ("estop/tester/one/e1", b"\xc1"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_malformed_message_is_dropped_counted_and_latches_nothing(
    system: MemorySystem, eventually: Eventually, what: str
) -> None:
    drivers(system, "one")
    one = system.container("one")
    key, payload = BAD[what]
    MemoryTransport(system.network, "raw").publish(key).put(payload)
    assert eventually(lambda: one.dropped_messages == 1)
    assert one.estops() == []
    assert call(one, "move_to", "one", 0.1) == 0.1


def entry_with(estop: Estop) -> ProviderInfo:
    """What a container says that has it open."""
    return ProviderInfo(
        revision=1,
        groups=("trade",),
        kind="Estops",
        host="h",
        pid=1,
        services=(ServiceInfo(name="estops", signature="estops()"),),
        estops=(estop,),
    )


def test_an_estop_with_a_path_as_its_id_is_dropped_and_not_written(eventually: Eventually) -> None:
    """Its id names a file."""
    with tempfile.TemporaryDirectory() as folder, memory_system(state_dir=Path(folder)) as system:  # ids are short
        drivers(system, "one")
        one, raw, mallory = (
            system.container("one"),
            MemoryTransport(system.network, "raw"),
            Address("mallory", "x", "e"),
        )
        up = "/.." * len((Path(folder) / "memory" / "estop").parts[1:])
        reported = entry_with(Estop(f"{up}{folder}/found", str(mallory), "", 0.0))
        before, _sign = one.dropped_messages, raw.appear(alive_key(mallory))
        system.settle()
        raw.announce(registry_key("trade", mallory, "estops"), encode_message(reported))
        assert eventually(lambda: one.dropped_messages > before or bool(one.estops()))
        one.close()  # what it writes is written
        assert not list(Path(folder).glob("found*"))
        assert one.dropped_messages > before


def test_S09_an_estop_reported_by_another_container_is_recorded_with_its_reporter(
    system: MemorySystem, eventually: Eventually
) -> None:
    """Its giver never gave it, perhaps."""
    drivers(system, "one")
    one, raw, mallory = (
        system.container("one"),
        MemoryTransport(system.network, "raw"),
        Address("mallory", "x", "e"),
    )
    rows: list[Event] = []
    one._parts.audit._tell = rows.append
    reported = entry_with(Estop("abc", "boss/desk/e1", "fire", 0.0, told_by="boss/desk"))
    _sign = raw.appear(alive_key(mallory))
    system.settle()
    raw.announce(registry_key("trade", mallory, "estops"), encode_message(reported))
    assert eventually(lambda: bool(one.estops()))
    assert [(known.by, known.told_by) for known in one.estops()] == [("boss/desk/e1", "mallory/x")]
    late = system.container("late")
    assert eventually(lambda: bool(late.estops()))
    assert late.estops()[0].giver != "boss/desk/e1"
    heard = one.estop("smoke", limit_s=0.5)  # mallory never confirms
    assert eventually(lambda: {known.id: known.told_by for known in late.estops()}.get(heard.id) == "")
    [row] = [row for row in rows if row.about == "abc"]
    assert (row.who, row.why) == ("boss", "fire (reported by mallory/x)")


def test_S09_an_estop_causes_only_small_announcements_between_containers(system: MemorySystem) -> None:
    """It is as much as the square of how many there are, in a moment that matters."""
    drivers(system, *(f"d{number}" for number in range(4)))
    caller, reported = system.container("caller"), Counter[str]()

    def hear(passage: InFlightMessage) -> None:
        if passage.kind is MessageKind.ANNOUNCE and not passage.arrived:
            reported[passage.source] += len(passage.payload or b"")

    system.tap(hear)
    caller.estop_clear([caller.estop(limit_s=GENEROUS_S).id], limit_s=GENEROUS_S)
    system.settle()
    others, changes = 4, 2
    assert len(reported) == 5
    assert max(reported.values()) <= others * changes * MOST_BYTES_OF_ESTOPS


def test_S09_orders_reach_a_container_that_is_busy_with_calls(system: MemorySystem) -> None:
    [axis] = drivers(system, "one")
    caller = system.container("caller")
    run = caller.find(where(name="run"), wait_s=20).with_(deadline_s=GENEROUS_S)
    runs = [run.start() for _ in range(MOST_THREADS)]
    assert axis.begun.wait(GENEROUS_S)
    assert caller.estop(limit_s=GENEROUS_S).complete
    for one in runs:
        assert one.exception(GENEROUS_S) is None or isinstance(one.exception(), (Stopped, Busy))


def test_a_clearing_that_was_recorded_clears_no_later_e_stop(system: MemorySystem) -> None:
    drivers(system, "one")
    one, recorded = system.container("one"), list[tuple[str, bytes]]()
    system.tap(lambda passage: recorded.append((passage.key, passage.payload or b"")))
    report = system.container("caller").estop("smoke", limit_s=GENEROUS_S)
    assert system.container("caller").estop_clear([report.id], limit_s=GENEROUS_S).complete
    orders = [(key, payload) for key, payload in recorded if key.startswith("estop/") and key.count("/") == 1]
    clearing = [order for order in orders if decode_estop_order(order[1], order[0][6:]).cleared]
    raw = MemoryTransport(system.network, "raw")
    second = system.container("caller").estop("fire", limit_s=GENEROUS_S)
    for key, payload in clearing:  # it names the one that it was for
        raw.publish(key).put(payload)
    system.settle()
    assert [estop.id for estop in one.estops()] == [second.id]
    with pytest.raises(Stopped):
        call(one, "move_to", "one", 0.1)


def test_S09_a_container_whose_registry_is_unread_is_reported_as_missing() -> None:
    """It may have something to stop: without its word an e-stop is not complete."""
    with memory_system() as system:
        near, far, me = (system.container(name) for name in ("near", "far", "me"))
        near.register(Axis("near"), "rosie.near")
        far.register(Axis("far"), "rosie.far")
        system.settle()
        registry = me._parts.registry
        [state] = [one for one in registry.containers() if one.address == far.address]
        state.heard.answered = -1  # as it is before its answer has come
        state.heard._first = 2
        state.providers.clear()
        system.lose(lambda passage: passage.source == "far")  # neither its confirmation nor its answer to a call
        report = me.estop("smoke", limit_s=0.5)
        assert not report.complete
        assert [name.rpartition("/")[2] for name in report.missing] == ["far"]


def test_work_that_comes_while_the_last_step_ends_is_done() -> None:
    steps: list[float] = []

    def step() -> None:
        steps.append(time.monotonic())
        if len(steps) == 1:
            worker.wake()  # another e-stop: the thread is about to end

    worker = Worker(step, "one e-stop after the other")
    worker.wake()
    worker.close()
    assert len(steps) == 2
