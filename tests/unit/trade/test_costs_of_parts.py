"""What each part of the middleware may cost, counted instead of timed: messages between containers, functions, memory.

| what | guarded here | elsewhere |
|---|---|---|
| call, started call, local call | messages; a local one and the kernel | lookups, memory: `test_costs` |
| call through a gateway | one that shares: two calls | one that bridges runs no Python for it |
| notification | one call each, nothing while it waits | |
| stream | one sample to each listener, one reading for all | rates: `test_streams` |
| hook | here: nothing; elsewhere: one call | |
| lock, unlock, renewal | by containers, not by services or locks | |
| find | functions and memory, whatever is known | the index: `test_index` |
| registry: join, register, leave, at rest | bytes of all | messages: `test_memory_system` |
| e-stop | | `test_estop`: confirmations, bytes |
| audit record | no message; rows together in few transactions | what is written: `test_audit` |
| bus loops of the drivers | | `tests/unit/drivers/test_costs.py` |

Everything runs on the network in memory, where each message between two containers is seen.
"""

import gc
import os
import shutil
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.test_costs import blocks, functions_run, traced
from trade import Container, Handle, HookEvent, Settings, service, where
from trade._audit.hash_chain import AuditRow
from trade._audit.store import AuditStore
from trade._threads import scheduler
from trade.sharing import Border
from trade.testing import MemorySystem, MessageKind, memory_system
from trade.transport.memory import InFlightMessage, MemoryTransport

pytestmark = pytest.mark.virtual_time

TIMES = 20
LONG_S = 60.0
"""A lease that needs no renewal while a test runs."""
MOST_BLOCKS_KEPT = 100


class Joint:
    def __init__(self) -> None:
        self.asked = 0

    @service
    def move(self, angle_rad: float) -> float:
        return angle_rad

    @service(effect="read")
    def angle(self) -> float:
        self.asked += 1
        return float(self.asked)

    @service(effect="stop")
    def stop(self) -> None: ...


class Heard:
    """What goes from one container to another."""

    def __init__(self, system: MemorySystem) -> None:
        self._system = system
        self.kinds: Counter[MessageKind] = Counter()
        self.streamed: Counter[str] = Counter()
        self.bytes = 0
        system.tap(self._hear)

    def _hear(self, passage: InFlightMessage) -> None:
        if passage.arrived:
            return
        if passage.key.startswith("stream/") and passage.kind not in (MessageKind.RISE, MessageKind.FALL):
            self.streamed[passage.target] += 1
            return
        self.kinds[passage.kind] += 1
        self.bytes += len(passage.key) + len(passage.payload or b"")

    @contextmanager
    def exactly(self, **kinds: int) -> Iterator[None]:
        """Of these kinds so many messages pass meanwhile, and no others; before, containers get to know each other."""
        self._system.settle()
        self.kinds.clear()
        yield
        assert {kind.name.lower(): count for kind, count in self.kinds.items() if count} == kinds


@pytest.fixture
def system() -> Iterator[MemorySystem]:
    with memory_system() as made:
        yield made


@pytest.fixture
def heard(system: MemorySystem) -> Heard:
    return Heard(system)


@pytest.fixture
def here(system: MemorySystem) -> Container:
    return system.container("here")


@pytest.fixture
def there(system: MemorySystem) -> Container:
    return system.container("there")


def known(here: Container, there: Container, group: str = "robot", name: str = "move") -> Handle:
    """A handle of a service there, called once, so that the clocks know each other."""
    there.register(Joint(), group)
    handle = here.find(where(name=name, group=group), wait_s=20).with_(deadline_s=20)
    handle(*([0.1] if name == "move" else []))
    return handle


def test_calls_and_started_calls_are_two_messages(here: Container, there: Container, heard: Heard) -> None:
    move = known(here, there)
    with heard.exactly(put=2 * TIMES):
        for _ in range(TIMES):
            move(0.1)
    with heard.exactly(put=2 * TIMES):
        for run in [move.start(0.1) for _ in range(TIMES)]:
            run.result(20)


def test_what_calls_of_another_container_leave_behind_does_not_grow(here: Container, there: Container) -> None:
    """But for what is kept so that no call runs twice: so it is reading that is looked at."""
    angle = known(here, there, name="angle")
    for _ in range(10 * TIMES):
        angle()
    with traced():
        angle()
        before = blocks()
        calls = 50 * TIMES
        for _ in range(calls):
            angle()
        assert blocks() - before < calls / 2  # one that is kept of each call would be more


def test_a_call_across_systems_is_one_call_in_each() -> None:
    with memory_system() as lab, memory_system() as clinic:
        robot, ours = lab.container("robot"), lab.container("door")
        robot.register(Joint(), "robot")
        ours.find(where(name="move"), wait_s=20)
        made: list[Container] = []
        for name in ("anna", "door"):
            settings = Settings(system="clinic", identity="tester", container=name)
            made.append(Container(settings, transport=MemoryTransport(clinic.network, name)))
        anna, theirs = made
        border = Border(ours, theirs, exported=["robot"])
        move = anna.find(where(name="move"), wait_s=20).with_(deadline_s=20)
        move(0.1)
        sent = [Heard(one) for one in (lab, clinic)]
        with sent[0].exactly(put=2 * TIMES), sent[1].exactly(put=2 * TIMES):
            for _ in range(TIMES):
                move(0.1)
        border.close()
        for container in made:
            container.close()


LOCAL_CALLS = """
import os, sys
from trade import service
from trade.testing import memory_system

class Joint:
    @service
    def move(self, angle_rad: float) -> float:
        return angle_rad

with memory_system() as system:
    move, *_ = system.container("here").register(Joint(), "robot")
    for _ in range(100):
        move(0.1)
    os.getppid()
    for _ in range(2000):
        move(0.1)
    os.getppid()
"""


@pytest.mark.realtime
def test_a_local_call_does_not_enter_the_kernel(tmp_path: Path) -> None:
    if shutil.which("strace") is None:
        pytest.fail("there is no strace") if os.environ.get("CI") == "true" else pytest.skip("there is no strace")
    reported = tmp_path / "trace"
    command = ["strace", "-o", str(reported), sys.executable, "-c", LOCAL_CALLS]  # of its main thread only
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    if "ptrace" in done.stderr:
        pytest.skip(f"strace may not look: {done.stderr}")
    assert done.returncode == 0, done.stderr
    lines = reported.read_text().splitlines()
    first, last = (number for number, line in enumerate(lines) if line.startswith("getppid("))
    calls = [line for line in lines[first + 1 : last] if not line.startswith("---")]
    assert len(calls) <= 100, calls  # to wait its turn among threads, and for memory; not one for each of 2,000 calls


def test_a_notification_is_one_call_and_nothing_while_it_waits(
    here: Container, there: Container, system: MemorySystem, heard: Heard
) -> None:
    reported = threading.Semaphore(0)

    class Listener:
        @service
        def came(self, which: Handle) -> None:
            reported.release()

    there.register(Listener(), "listener")
    came = here.find(where(name="came"), wait_s=20)
    with heard.exactly():
        standing = here.joined(where(name="move"), call=came)
    system.container("third").register(Joint(), "first")
    assert reported.acquire(timeout=20)
    system.settle()
    third = system.container("third")
    with heard.exactly(announce=2, put=2):
        third.register(Joint(), "second")
        assert reported.acquire(timeout=20)
        wait_until(lambda: standing.info().fired == 2, "its call has been answered")
        wait_until(lambda: heard.kinds[MessageKind.PUT] == 2, "the answer has passed")
    with heard.exactly():
        standing.cancel()


@pytest.mark.parametrize("listeners", [1, 4])
def test_a_sample_is_read_once_and_sent_once_to_each_listener(
    system: MemorySystem, there: Container, heard: Heard, listeners: int
) -> None:
    joint = Joint()
    there.register(joint, "robot")
    ears = [system.container(f"ear-{number}") for number in range(listeners)]
    streams = [ear.stream(ear.find(where(name="angle", group="robot"), wait_s=20), hz=200.0, keep=1000) for ear in ears]
    wait_until(lambda: all(heard.streamed[ear.name] >= TIMES for ear in ears), "all have heard many samples")
    for stream in streams:
        stream.close()
    asked, reported = joint.asked, heard.streamed
    assert set(reported) == {ear.name for ear in ears}
    assert max(reported.values()) <= asked + 2 * listeners  # who begins to listen is given one at once
    assert heard.kinds[MessageKind.PUT] <= 2 * listeners * (
        2 + 2 + asked // 200
    )  # to ask for it, again every two seconds


def test_a_hook_of_the_same_container_takes_no_message_and_another_containers_one_call(
    here: Container, there: Container, system: MemorySystem, heard: Heard
) -> None:
    seen: list[HookEvent] = []

    class Watcher:
        @service(effect="note")
        def watch(self, called: HookEvent) -> None:
            seen.append(called)

    move = known(here, there)
    there.register(Watcher(), "near")
    target = there.find(where(name="move"))
    near = there.before_service(target, there.find(where(name="watch", group="near")))
    move(0.1)
    with heard.exactly(put=2 * TIMES):
        for _ in range(TIMES):
            move(0.1)
    near.detach()
    third = system.container("third")
    third.register(Watcher(), "far")
    there.before_service(target, there.find(where(name="watch", group="far"), wait_s=20))
    move(0.1)
    seen.clear()
    with heard.exactly(put=4 * TIMES):
        for _ in range(TIMES):
            move(0.1)
    assert len(seen) == TIMES


@pytest.mark.parametrize("services", [1, 10])
@pytest.mark.parametrize("containers", [1, 3])
def test_a_lock_is_two_calls_to_each_container_however_many_services_it_has(
    system: MemorySystem, here: Container, heard: Heard, containers: int, services: int
) -> None:
    names = [f"host-{number}" for number in range(containers)]
    for name in names:
        for number in range(services):
            known(here, system.container(name), f"robot.{name}-{number}")
    lock = here.lock(where(group="robot"), lease_s=LONG_S)
    with heard.exactly(put=2 * containers):
        lock.acquire()
    assert len(lock.resources) == containers * services
    with heard.exactly(urgent=containers, put=containers):
        lock.release()


def test_a_renewal_is_one_call_to_each_container_however_many_locks(
    here: Container, there: Container, heard: Heard
) -> None:
    moves = [known(here, there, f"robot.j{number}") for number in range(5)]
    locks = [here.lock([move], lease_s=LONG_S).acquire() for move in moves]
    with heard.exactly(urgent=1, put=1):
        here.lock_api.lease_client._renew(locks)
        wait_until(lambda: heard.kinds[MessageKind.PUT] == 1, "it has been answered")
    for lock in locks:
        lock.release()


def test_find_takes_the_same_steps_among_ten_services_and_among_two_thousand(here: Container) -> None:
    def steps() -> int:
        find: Callable[[], object] = lambda: here.find(where(name="move", group="robot.j3"))  # noqa: E731
        find()
        return functions_run(find)

    for number in range(5):
        here.register(Joint(), f"robot.j{number}")
    few = steps()
    for number in range(5, 700):
        here.register(Joint(), f"robot.j{number}")
    assert steps() <= few + 2
    with traced():
        here.find(where(name="move", group="robot.j3"))
        before = blocks()
        for _ in range(TIMES):
            here.find(where(name="move", group="robot.j3"))
        assert blocks() - before <= MOST_BLOCKS_KEPT


MOST_BYTES_OF_A_JOIN = 66 * 1024
"""For each present container: what both announce to each other of the middleware's own functions."""
MOST_BYTES_OF_A_BEAT = 256
MOST_BYTES_OF_A_LEAVE = 256


@pytest.mark.parametrize("containers", [2, 6])
def test_join_heartbeat_and_shutdown_have_a_bounded_cost_per_container(
    system: MemorySystem, heard: Heard, containers: int
) -> None:
    for number in range(containers):
        system.container(f"c{number}")
    system.settle()
    heard.bytes = 0
    late = system.container("late")
    system.settle()
    assert heard.bytes <= MOST_BYTES_OF_A_JOIN * containers
    heard.bytes = 0
    with heard.exactly(announce=containers):
        late._parts.announcer.beat(2)
    assert heard.bytes <= MOST_BYTES_OF_A_BEAT * containers
    heard.bytes = 0
    late.close()
    system.settle()
    assert heard.bytes <= MOST_BYTES_OF_A_LEAVE * containers


def test_a_container_takes_no_more_threads_however_many_others_there_are(system: MemorySystem) -> None:
    def threads() -> int:
        gc.collect()
        return sum(one.name.startswith("trade-") for one in threading.enumerate())

    system.container("c0")
    threading.Event().wait(2 * scheduler._IDLE_S)
    each = threads()
    for number in range(1, 8):
        system.container(f"c{number}")
    system.settle()
    assert threads() <= 8 * 9
    threading.Event().wait(2 * scheduler._IDLE_S)  # until idle threads have ended
    assert threads() == 8 * each


def test_an_audit_record_sends_nothing_and_is_written_many_rows_at_a_time(
    system: MemorySystem, here: Container, heard: Heard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrote: list[int] = []
    go_on = threading.Event()
    add = AuditStore.add

    def slowly(store: AuditStore, rows: Sequence[AuditRow]) -> object:
        """The disk is as slow as it can be: no caller waits for it."""
        assert go_on.wait(60)
        wrote.append(len(rows))
        return add(store, rows)

    monkeypatch.setattr(AuditStore, "add", slowly)
    settings = Settings(system="memory", identity="tester", container="there", audit=tmp_path)
    there = Container(settings, transport=MemoryTransport(system.network, "there"))
    move = known(here, there)
    calls = 200
    with heard.exactly(put=2 * calls):
        for _ in range(calls):
            move(0.1)
    go_on.set()
    there.close()
    assert sum(wrote) >= calls
    assert len(wrote) <= 3  # what there was at first, all that has come since, and the end
