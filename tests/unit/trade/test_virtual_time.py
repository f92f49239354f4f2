"""Virtual time: waits cost nothing, the same seed gives the same run, and what it cannot do is refused by name."""

import _thread
import asyncio
import http.client
import importlib
import queue
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from trade import Container, Settings, service, where
from trade.testing import Deadlock, VirtualTime, VirtualTimeError, memory_system, virtual_time

HERE = [__name__.partition(".")[0]]
ROOT = Path(__file__).parents[3]


@pytest.fixture
def clock() -> Iterator[VirtualTime]:
    with virtual_time(seed=1, packages=HERE) as clock:
        yield clock


class Arm:
    @service
    def move(self, to_rad: float) -> float:
        time.sleep(3.0)
        return to_rad


def test_a_sleep_takes_its_time_on_the_clock_and_none_of_the_computers(clock: VirtualTime) -> None:
    began, wall = time.monotonic(), time.time()
    time.sleep(86_400 / 25)
    assert time.monotonic() - began == pytest.approx(3456, abs=0.01)
    assert time.time() - wall == pytest.approx(3456, abs=0.01)
    assert clock.elapsed_s == pytest.approx(3456, abs=0.01)


def test_threads_wait_for_each_other_by_every_primitive(clock: VirtualTime) -> None:
    heard: queue.SimpleQueue[str] = queue.SimpleQueue()
    go, ready = threading.Event(), threading.Condition()
    seen: list[str] = []

    def work() -> None:
        assert go.wait(10)
        time.sleep(1)
        heard.put("one")
        with ready:
            seen.append("two")
            ready.notify_all()

    worker = threading.Thread(target=work)
    worker.start()
    go.set()
    assert heard.get(timeout=5) == "one"
    with ready:
        assert ready.wait_for(lambda: seen, 5)
    worker.join(1)
    assert not worker.is_alive()
    assert 1 <= clock.elapsed_s < 1.01


def test_threads_meet_at_a_barrier(clock: VirtualTime) -> None:
    barrier, met = threading.Barrier(3), list[float]()

    def come(after_s: float) -> None:
        time.sleep(after_s)
        barrier.wait(60)
        met.append(clock.elapsed_s)

    threads = [threading.Thread(target=come, args=[after_s]) for after_s in (1, 2, 30)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert met == [pytest.approx(30, abs=0.01)] * 3


def test_a_wait_ends_at_its_deadline(clock: VirtualTime) -> None:
    with pytest.raises(queue.Empty):
        queue.SimpleQueue().get(timeout=7)
    assert not threading.Event().wait(3)
    lock = threading.Lock()
    assert lock.acquire()
    assert not lock.acquire(timeout=2)
    assert clock.elapsed_s == pytest.approx(12, abs=0.01)


def test_a_timer_calls_at_its_time_and_not_after_it_was_cancelled(clock: VirtualTime) -> None:
    called: list[float] = []
    threading.Timer(5, lambda: called.append(time.monotonic())).start()
    cancelled = threading.Timer(6, lambda: called.append(0.0))
    cancelled.start()
    time.sleep(5.5)
    cancelled.cancel()
    time.sleep(5)
    assert len(called) == 1


def test_executors_and_asyncio_are_on_the_same_clock(clock: VirtualTime) -> None:
    with ThreadPoolExecutor(2) as pool:
        assert [run.result(5) for run in [pool.submit(time.sleep, 2), pool.submit(time.sleep, 2)]] == [None, None]
    assert clock.elapsed_s == pytest.approx(2, abs=0.01)

    async def both() -> None:
        await asyncio.gather(asyncio.sleep(4), asyncio.to_thread(time.sleep, 3))

    asyncio.run(both())
    assert clock.elapsed_s == pytest.approx(6, abs=0.01)


def test_an_http_server_and_its_clients_are_on_the_same_clock(clock: VirtualTime) -> None:
    serving: queue.Queue[tuple[asyncio.AbstractEventLoop, asyncio.Event, int]] = queue.Queue()

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        await asyncio.sleep(60)
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\nConnection: close\r\n\r\nready")
        writer.close()

    async def serve() -> None:
        over = asyncio.Event()
        async with await asyncio.start_server(answer, "127.0.0.1", 0) as server:
            serving.put((asyncio.get_running_loop(), over, server.sockets[0].getsockname()[1]))
            await over.wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    loop, over, port = serving.get(timeout=5)
    client = http.client.HTTPConnection("127.0.0.1", port, timeout=100)
    client.request("GET", "/")
    assert client.getresponse().read() == b"ready"
    client.close()
    assert clock.elapsed_s == pytest.approx(60, abs=0.01)
    loop.call_soon_threadsafe(over.set)
    thread.join(5)


class _Worker(threading.Thread):
    def run(self) -> None:
        time.sleep(7)


def test_classes_that_are_threads_are_on_the_same_clock(clock: VirtualTime) -> None:
    worker = _Worker()
    worker.start()
    worker.join(5)
    assert worker.is_alive()
    worker.join()
    assert not worker.is_alive()
    assert clock.elapsed_s == pytest.approx(7, abs=0.01)


def test_a_thread_that_virtual_time_did_not_start_sets_no_event(clock: VirtualTime) -> None:
    event, problems = threading.Event(), list[BaseException]()

    def intrude() -> None:
        try:
            event.set()
        except VirtualTimeError as refused:
            problems.append(refused)
        finally:
            done.release()

    done = _thread.allocate_lock()
    done.acquire()
    _thread.start_new_thread(intrude, ())
    done.acquire()
    assert "it was there before virtual time began" in str(*problems)
    assert not event.is_set()


def test_stalls_spare_devices(clock: VirtualTime) -> None:
    took: dict[str, float] = {}

    def work() -> None:
        began, lock = time.monotonic(), threading.Lock()
        for _ in range(20):
            with lock:
                pass
        took[threading.current_thread().name] = time.monotonic() - began

    clock.stall_threads(1.0, 2.0, spare="sim-")
    threads = [threading.Thread(target=work, name=name) for name in ("driver", "sim-bus")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert took["driver"] > 1
    assert took["sim-bus"] < 0.01


def test_containers_lock_move_and_expire(clock: VirtualTime) -> None:
    with memory_system() as system:
        robot, one = (system.container(name) for name in ("robot", "one"))
        robot.register(Arm(), "arm")
        move = one.find(where(name="move"), wait_s=5)
        assert move(0.5) == 0.5
        with pytest.raises(TimeoutError):
            move.with_(deadline_s=1)(0.5)
    assert clock.elapsed_s < 20


def test_containers_started_by_name_are_linked_in_memory(clock: VirtualTime) -> None:
    with (
        Container(Settings.read(system="virtual", container="a")) as one,
        Container(Settings.read(system="virtual", container="b")) as other,
    ):
        one.register(Arm(), "arm")
        assert other.find(where(name="move"), wait_s=5)(0.1) == 0.1


def _order(seed: int) -> tuple[list[int], int]:
    """In which order five threads take a lock, and how often threads took turns."""
    taken: list[int] = []
    with virtual_time(seed=seed, switch=0.3, packages=HERE) as clock:
        lock = threading.Lock()

        def take(number: int) -> None:
            for _ in range(5):
                with lock:
                    taken.append(number)
                    time.sleep(0.001)

        threads = [threading.Thread(target=take, args=[number]) for number in range(5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return taken, clock.switches


def test_the_same_seed_gives_the_same_order_and_another_one_another() -> None:
    assert _order(7) == _order(7)
    assert len({tuple(_order(seed)[0]) for seed in range(8)}) > 1


def test_a_deadlock_is_an_error_with_the_stack_of_each_thread() -> None:
    stacks = r"(?s)--- main.*never_set.wait\(\).*--- stuck.*lock.acquire\(\)"
    with pytest.raises(Deadlock, match=stacks), virtual_time(packages=HERE):
        lock, never_set = threading.Lock(), threading.Event()
        lock.acquire()

        def wait() -> None:
            lock.acquire()

        threading.Thread(target=wait, name="stuck").start()
        never_set.wait()


def test_a_thread_that_is_left_behind_is_named_and_ended() -> None:
    thread = None
    with pytest.raises(VirtualTimeError, match="threads are left behind: forgotten"), virtual_time(packages=HERE):
        thread = threading.Thread(target=lambda: time.sleep(1000), name="forgotten")
        thread.start()
    assert thread is not None
    threading.Thread.join(thread, 10)
    assert "forgotten" not in {one.name for one in threading.enumerate()}


def test_a_loop_that_only_reads_the_clock_ends(clock: VirtualTime) -> None:
    until = time.monotonic() + 30
    while time.monotonic() < until:
        pass


def test_a_test_that_waits_in_circles_ends_at_its_limit() -> None:
    passed = "more than 100 s of virtual time have passed"
    with pytest.raises(VirtualTimeError, match=passed), virtual_time(packages=HERE, limit_s=100):
        while True:
            time.sleep(1)


def test_a_process_is_refused_by_name(clock: VirtualTime) -> None:
    with pytest.raises(VirtualTimeError, match=r"subprocess\.run was called"):
        subprocess.run(["true"], check=True)


def test_everything_is_as_before_at_the_end() -> None:
    before = (time.monotonic, threading.Lock, queue.SimpleQueue)
    with virtual_time(packages=HERE):
        assert time.monotonic is not before[0]
    assert (time.monotonic, threading.Lock, queue.SimpleQueue) == before
    with pytest.raises(KeyError), virtual_time(packages=HERE):
        raise KeyError
    assert (time.monotonic, threading.Lock, queue.SimpleQueue) == before


def test_a_test_knows_whether_its_time_is_virtual_and_has_one_time(clock: VirtualTime) -> None:
    assert VirtualTime.current() is clock
    with pytest.raises(VirtualTimeError, match="virtual time runs already"), virtual_time(packages=HERE):
        pass
    assert VirtualTime.current() is clock


def test_outside_of_virtual_time_there_is_none() -> None:
    with pytest.raises(KeyError), virtual_time(packages=HERE):
        raise KeyError
    assert VirtualTime.current() is None


def test_a_module_that_is_imported_again_has_the_time_of_its_test(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """pytest loads all modules of tests by one loader, which no earlier test may have changed."""
    (tmp_path / "test_imported_again.py").write_text("import time\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    for _ in range(3):
        with virtual_time(packages=["test_imported_again"]) as clock:
            importlib.import_module("test_imported_again").time.sleep(7)
            assert clock.elapsed_s >= 7
        sys.modules.pop("test_imported_again")
    assert importlib.import_module("test_imported_again").time is time
    sys.modules.pop("test_imported_again")


def test_ids_come_from_the_seed() -> None:
    addresses = list[str]()
    for _ in range(2):
        with virtual_time(seed=3), memory_system() as system:
            addresses.append(str(system.container("robot").address))
    assert addresses[0] == addresses[1]


BOUND_AT_IMPORT = re.compile(r" = (time|threading|queue)\.\w+( *$|[,)])")
"""A default argument. On virtual time, its function would wait for the real clock."""


@pytest.mark.parametrize("package", ["trade", "drivers", "gateway", "hil-sim"])
def test_no_default_argument_binds_a_clock_or_a_thread(package: str) -> None:
    modules = {path: path.read_text() for path in (ROOT / package).rglob("*.py") if path.parent.name != "virtual"}
    assert len(modules) > 20
    assert [path.name for path, source in modules.items() if BOUND_AT_IMPORT.search(source)] == []
