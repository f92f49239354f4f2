"""Serial services: one at a time, in order of arrival, and no thread for each that waits."""

import asyncio
import threading
from typing import Any

import pytest

from trade import Container, Handle, service, where
from trade._threads import fork_guard
from trade.errors import Busy, Cancelled, ConfigurationError, DeadlineExceeded
from trade.stop_line.listener import Listener

pytestmark = pytest.mark.virtual_time


class Bench:
    def __init__(self) -> None:
        self.entered, self.open = threading.Event(), threading.Event()
        self.inside = self.most = 0
        self.order: list[int] = []

    @service(serial=True)
    def work(self, number: int) -> int:
        self.inside += 1
        self.most = max(self.most, self.inside)
        self.order.append(number)
        self.entered.set()
        self.open.wait(30)
        self.inside -= 1
        return number

    @service(serial=True)
    def nested(self, other: Handle) -> int:
        self.open.set()
        return other(5)

    @service(serial=True)
    async def work_async(self, number: int) -> int:
        self.order.append(number)
        await asyncio.sleep(0)
        return number

    @service
    def beside(self) -> str:
        return "beside"

    @service(effect="stop")
    def stop(self) -> str:
        return "stopped"


@pytest.fixture
def bench() -> Any:
    bench = Bench()
    yield bench
    bench.open.set()


def test_serial_calls_run_one_at_a_time_in_order_of_arrival(offer: Any, bench: Bench, eventually: Any) -> None:
    work = offer(bench)("work")
    serial = work_serial(work)
    runs = []
    for i in range(5):
        runs.append(work.start(i))
        assert bench.entered.wait(20)
        assert eventually(lambda i=i: len(serial._queue) == i)
    bench.open.set()
    assert [run.result(20) for run in runs] == list(range(5))
    assert (bench.order, bench.most) == (list(range(5)), 1)


def work_serial(work: Handle) -> Any:
    """The queue behind a handle, wherever its provider lives."""
    [home] = [one for one in fork_guard.live if one.address == work.key.address]
    service = home._parts.providers.lookup(f"{work.key.domain}/{work.key.provider}", work.name)
    assert service is not None
    return service.serial


def test_waiting_takes_no_threads_and_neither_stops_nor_others_wait(
    here: Container, there: Container, bench: Bench, eventually: Any
) -> None:
    there.register(bench, "robot")
    work, beside, stop = (here.find(where(name=name), wait_s=20) for name in ("work", "beside", "stop"))
    runs = [work.start(i) for i in range(200)]
    assert eventually(lambda: len(work_serial(work)._queue) == 199)
    assert len(there._parts.dispatcher.pools[0]._threads) < 50  # 199 wait; taking calls in may itself need several
    assert (beside(), stop()) == ("beside", "stopped")
    bench.open.set()
    assert sorted(run.result(30) for run in runs) == list(range(200))
    assert bench.most == 1


def test_a_call_whose_deadline_passes_while_it_waits_never_runs(offer: Any, bench: Bench) -> None:
    work = offer(bench)("work")
    first = work.start(0)
    assert bench.entered.wait(20)
    assert isinstance(work.with_(deadline_s=0.3).start(1).exception(20), TimeoutError)
    bench.open.set()
    assert first.result(20) == 0
    assert work(2) == 2
    assert bench.order == [0, 2]


def test_a_local_caller_learns_that_its_turn_did_not_come(here: Container, bench: Bench) -> None:
    here.register(bench, "robot")
    work = here.find(where(name="work"))
    first = work.start(0)
    assert bench.entered.wait(20)
    with pytest.raises(DeadlineExceeded):
        work.with_(deadline_s=0.1)(1)
    bench.open.set()
    assert first.result(20) == 0


def test_local_and_remote_callers_share_one_queue(
    here: Container, there: Container, bench: Bench, eventually: Any
) -> None:
    there.register(bench, "robot")
    remote, local = (one.find(where(name="work"), wait_s=20) for one in (here, there))
    runs = []
    for i in range(6):
        runs.append((remote, local)[i % 2].start(i))
        assert bench.entered.wait(20)
        assert eventually(lambda i=i: len(work_serial(remote)._queue) == i)
    bench.open.set()
    assert [run.result(20) for run in runs] == bench.order == list(range(6))
    assert bench.most == 1


def test_a_queued_call_that_is_cancelled_is_dropped_at_once(offer: Any, bench: Bench, eventually: Any) -> None:
    work = offer(bench)("work")
    first, second = work.start(0), None
    assert bench.entered.wait(20)
    second = work.start(1)
    assert eventually(lambda: len(work_serial(work)._queue) == 1)
    second.cancel()
    assert isinstance(second.exception(20), Cancelled)
    assert not first.done()
    bench.open.set()
    assert first.result(20) == 0
    assert bench.order == [0]


def test_a_serial_service_may_call_another_of_its_own_provider_here(here: Container, bench: Bench) -> None:
    here.register(bench, "robot")
    nested, work = here.find(where(name="nested")), here.find(where(name="work"))
    assert nested(work) == 5


def test_async_services_are_serial_too(offer: Any, bench: Bench) -> None:
    work = offer(bench)("work_async")
    runs = [work.start(i) for i in range(20)]
    assert sorted(run.result(20) for run in runs) == list(range(20))


def test_only_so_many_wait(
    here: Container, there: Container, bench: Bench, monkeypatch: pytest.MonkeyPatch, eventually: Any
) -> None:
    from trade._services import serial_queue

    monkeypatch.setattr(serial_queue, "MOST_WAITING", 2)
    there.register(bench, "robot")
    work = here.find(where(name="work"), wait_s=20)
    runs = [work.start(i) for i in range(4)]
    assert eventually(lambda: any(run.done() for run in runs))
    assert [type(run.exception()) for run in runs if run.done()] == [Busy]


def test_a_stop_cannot_be_serial() -> None:
    with pytest.raises(ConfigurationError, match="a stop cannot be serial"):
        service(effect="stop", serial=True)


@pytest.mark.real_clock
def test_what_waits_when_its_container_closes_never_runs(
    here: Container, there: Container, bench: Bench, eventually: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    there.register(bench, "robot")
    work = here.find(where(name="work"), wait_s=20)
    runs = [work.start(0)]
    assert bench.entered.wait(20)
    runs.append(work.start(1))
    assert eventually(lambda: len(work_serial(work)._queue) == 1)
    serial = work_serial(work)
    line, close = there._parts.stop_line, Listener.close
    assert line is not None
    line.listen_on_host()

    def close_late(listener: Listener) -> None:
        """The stop line closes after the others have seen the container leave: until then a queue may go on."""
        assert eventually(lambda: not serial._taken)
        close(listener)

    monkeypatch.setattr(Listener, "close", close_late)
    closing = threading.Thread(target=there.close)
    closing.start()
    assert all(isinstance(run.exception(20), ConnectionError) for run in runs)
    bench.open.set()
    closing.join(20)
    assert eventually(lambda: not serial._taken)
    assert bench.order == [0]
