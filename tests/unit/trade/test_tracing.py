"""Calls noted across containers: off it costs nothing, on it shows who called what, and how that ended."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import trade._telemetry.spans as noted
from tests.support.policies import policy_text
from trade import Container, Handle, HookEvent, Resource, Secret, Trace, current_call, service, where
from trade._services.local_service import LocalService
from trade.errors import AccessDenied, NoSuchCall
from trade.testing import MemorySystem

pytestmark = pytest.mark.virtual_time

Eventually = Callable[[Callable[[], bool]], bool]


class Arm:
    """Its word is never traced."""

    def __init__(self) -> None:
        self.resources = (Resource("rosie.arm"),)

    @service
    def reach(self, angle_rad: float) -> float:
        call = current_call()
        assert call is not None
        call.event(f"wrote {angle_rad}")
        if angle_rad > 1:
            raise ValueError("too far: swordfish")
        logging.getLogger("trade").warning("reached %s", angle_rad)
        return angle_rad

    @service(effect="read")
    def login(self, word: Secret[str]) -> str:
        return word

    @service(effect="stop")
    def stop(self) -> None: ...


class Mind:
    """Reaches under a lock of its own."""

    def __init__(self, container: Container) -> None:
        self.container = container

    @service
    def fetch(self, angle_rad: float) -> float:
        with self.container.lock(where(group="rosie.arm"), purpose="fetch"):
            return self.container.call(where(name="reach", group="rosie.arm"), angle_rad)


class Eye:
    def __init__(self) -> None:
        self.seen: queue.SimpleQueue[int] = queue.SimpleQueue()

    @service(effect="read")
    def see(self, called: HookEvent) -> None:
        self.seen.put(called.call_id)


@pytest.fixture
def arm(here: Container, there: Container) -> Arm:
    """There, and known here, as all of its container: what is announced now can be heard before what stood already."""
    provider = Arm()
    there.register(provider, "rosie.arm")
    here.find(where(name="reach"), wait_s=20)
    here.find(where(name="set_tracing", group="trade", container="there"), wait_s=20)
    return provider


def _services(trace: Trace) -> list[Any]:
    return [trace.service, [_services(call) for call in trace.calls]]


def _find(trace: Trace, name: str) -> Trace:
    found = [trace] if trace.service == name else []
    while not found:
        [*found] = [call for call in _every(trace) if call.service == name]
        assert found, f"no {name} in {_services(trace)}"
    return found[0]


def _every(trace: Trace) -> Iterator[Trace]:
    yield trace
    for call in trace.calls:
        yield from _every(call)


def _last(container: Container, name: str) -> int:
    return [span.call_id for span in container.spans() if span.service == name][-1]


def _served(container: Container, handle: Handle) -> LocalService:
    service = container._parts.providers.service(handle.key)
    assert service is not None
    return service


def test_untraced_services_are_not_wrapped_and_nothing_is_recorded(here: Container, there: Container, arm: Arm) -> None:
    reach = _served(there, here.find(where(name="reach"), wait_s=20))
    here.call(where(name="reach"), 0.1)
    assert reach.interceptors == ()
    assert here._parts.caller.spans is None
    assert here.spans() == []
    here.set_tracing(True)
    assert reach.interceptors
    here.set_tracing(False)
    assert reach.interceptors == ()
    assert here._parts.caller.spans is None


def test_traced_calls_are_numbered_so_that_a_reader_can_continue(
    here: Container, monkeypatch: pytest.MonkeyPatch, start_container: Any
) -> None:
    monkeypatch.setattr(noted, "MOST", 5)
    small = start_container("small")
    small.register(Arm(), "rosie.arm")
    spans = small.find(where(name="spans", container="small"))
    switch = small.find(where(name="set_tracing", container="small"))
    assert [switch(True), switch(True)] == [False, True]
    for step in range(8):
        small.call(where(name="reach"), step / 10)
    assert [span.number for span in spans()] == [4, 5, 6, 7, 8]
    assert [span.number for span in spans(None, 6)] == [7, 8]
    assert [span.number for span in spans(None, 2)] == [4, 5, 6, 7, 8]
    assert spans(None, 8) == spans(None, 9) == []


def test_the_number_of_traced_calls_is_bounded(
    here: Container, monkeypatch: pytest.MonkeyPatch, start_container: Any
) -> None:
    monkeypatch.setattr(noted, "MOST", 5)
    small = start_container("small")
    small.register(Arm(), "rosie.arm")
    small.set_tracing(True, container="small")
    for step in range(8):
        small.call(where(name="reach"), step / 10)
    spans = small.spans()
    assert [span.events[0][1] for span in spans] == [f"wrote {step / 10}" for step in range(3, 8)]


def test_events_of_one_call_are_bounded(here: Container) -> None:
    class Chatter:
        @service
        def talk(self) -> int:
            call = current_call()
            assert call is not None
            for number in range(1000):
                call.event(str(number))
            return len(call.events or ())

    here.register(Chatter(), "chat")
    assert here.call(where(name="talk")) == 0
    here.set_tracing(True)
    assert here.call(where(name="talk")) == 100
    assert len(here.spans()[0].events) == 100


def test_a_call_is_traced_by_caller_and_callee(here: Container, there: Container, arm: Arm) -> None:
    assert here.set_tracing(True) == ["here", "there"]
    here.find(where(name="reach"), wait_s=20)(0.25)
    asked, served = sorted(here.spans(), key=lambda span: span.side)
    assert (asked.side, asked.container, served.side, served.container) == ("asked", "here", "served", "there")
    assert asked.call_id == served.call_id
    assert {asked.service, served.service} == {"rosie.arm.reach"}
    assert (served.caller, served.session) == (here.address.identity, here.session)
    assert asked.session == here.session
    assert 0 < served.took_s <= asked.took_s
    assert (asked.outcome, served.outcome) == ("ok", "ok")
    [(after_s, text)] = served.events
    assert text == "wrote 0.25"
    assert 0 <= after_s <= served.took_s


def test_an_error_is_reported_by_its_type_alone(here: Container, there: Container, arm: Arm) -> None:
    here.set_tracing(True)
    with pytest.raises(ValueError, match="swordfish"):
        here.call(where(name="reach"), 2.0)
    assert [span.outcome for span in here.spans()] == ["ValueError"] * 2
    assert not any("swordfish" in str(span) for span in here.spans())


def test_a_refused_call_is_traced_by_the_caller(here: Container, there: Container, arm: Arm) -> None:
    reach = here.find(where(name="reach"), wait_s=20)
    here.set_tracing(True)
    with pytest.raises(Exception, match="angle_rad"):
        reach("far")
    there.deregister(arm)
    with pytest.raises(Exception):  # noqa: B017 - which one depends on who hears of it first
        reach(0.1)
    assert here.call(where(name="clock", container="there")) > 0
    assert [span.service for span in here.spans() if span.side == "served"] == []


def test_the_time_in_a_serial_queue_is_reported(here: Container, there: Container, eventually: Eventually) -> None:
    entered, released = threading.Event(), threading.Event()

    class Queue:
        @service(serial=True)
        def hold(self) -> None:
            entered.set()
            released.wait(20)

        @service(serial=True)
        def follow(self) -> None: ...

    there.register(Queue(), "q")
    here.find(where(name="follow"), wait_s=20)
    here.find(where(name="set_tracing", group="trade", container="there"), wait_s=20)
    here.set_tracing(True)
    first = here.find(where(name="hold")).start()
    assert entered.wait(20)
    second = here.find(where(name="follow")).start()
    serial = _served(there, here.find(where(name="follow"))).serial
    assert serial is not None
    assert eventually(lambda: bool(serial._queue))
    seen_waiting_ns = time.monotonic_ns()
    threading.Event().wait(0.02)
    waited_s = (time.monotonic_ns() - seen_waiting_ns) / 1e9
    released.set()
    first.result(20)
    second.result(20)
    served = {span.service: span for span in here.spans() if span.side == "served"}
    assert served["q.follow"].waited_s >= waited_s


@pytest.mark.real_clock  # ids repeat on virtual time, and the log of another test has the same
def test_what_is_secret_is_in_no_trace(here: Container, there: Container, arm: Arm) -> None:
    here.set_tracing(True)
    assert here.call(where(name="login"), "swordfish") == "swordfish"
    shown, secret, after = str(here.trace(_last(here, "rosie.arm.login"))).partition("swordfish")
    assert not secret, f"{shown[-300:]}{secret}{after[:100]}"


def test_the_tree_has_lock_nested_call_hook_event_and_log_line(
    here: Container, there: Container, arm: Arm, start_container: Any
) -> None:
    mind, eye = start_container("mind"), Eye()
    mind.register(Mind(mind), "mind")
    here.register(eye, "eye")
    fetch = here.find(where(name="fetch"), wait_s=20)
    mind.find(where(name="reach"), wait_s=20)
    here.before_service(where(name="reach"), here.find(where(name="see")))
    here.set_tracing(True)
    fetch(0.5)
    inner = eye.seen.get(timeout=20)
    trace = here.trace(inner)
    assert _services(trace) == [
        "mind.fetch",
        [["trade.acquire", []], ["rosie.arm.reach", [["eye.see", []]]], ["trade.release", []]],
    ]
    assert trace == here.trace(trace.call_id)
    reach = _find(trace, "rosie.arm.reach")
    assert reach.served is not None
    [lock] = reach.served.locks
    assert lock.startswith("fetch (")
    assert [text for _, text in reach.served.events] == ["wrote 0.5"]
    assert [(line.text, line.level_name) for line in reach.lines] == [("reached 0.5", "WARNING")]


def test_a_caller_that_is_not_traced_leaves_a_gap_and_no_more(
    here: Container, there: Container, arm: Arm, start_container: Any
) -> None:
    mind = start_container("mind")
    mind.register(Mind(mind), "mind")
    fetch = here.find(where(name="fetch"), wait_s=20)
    mind.find(where(name="reach"), wait_s=20)
    here.set_tracing(True, container="there")
    fetch(0.5)
    trace = here.trace(_last(here, "rosie.arm.reach"))
    names = [call.service for call in trace.calls]
    assert (trace.service, names) == ("(not traced)", ["trade.acquire", "rosie.arm.reach", "trade.release"])


def test_a_trace_request_for_an_unrecorded_call_is_an_error(here: Container) -> None:
    here.set_tracing(True)
    with pytest.raises(NoSuchCall, match="no container has traced call 12"):
        here.trace(12)


def test_services_that_join_later_are_traced_too(here: Container) -> None:
    here.set_tracing(True)
    here.register(Arm(), "rosie.arm")
    here.call(where(name="reach"), 0.1)
    assert [span.service for span in here.spans()] == ["rosie.arm.reach"]


def test_hooks_come_and_go_while_a_service_is_traced(here: Container) -> None:
    eye = Eye()
    [reach, *_] = here.register(Arm(), "rosie.arm")
    [see] = here.register(eye, "eye")
    here.set_tracing(True)
    hook = here.after_service(reach, see)
    reach(0.1)
    assert eye.seen.get(timeout=20) == _last(here, "rosie.arm.reach")
    hook.detach()
    reach(0.2)
    assert eye.seen.empty()
    here.set_tracing(False)
    count = len(here.spans())
    reach(0.3)
    assert len(here.spans()) == count


def test_a_container_may_be_traced_from_its_start(start_container: Any) -> None:
    born = start_container("born", environment={"TRADE_TRACE": "1"})
    born.register(Arm(), "rosie.arm")
    born.call(where(name="reach"), 0.1)
    assert [span.service for span in born.spans()] == ["rosie.arm.reach"]


POLICY = policy_text(
    "dash=viewer drv=driver chief=tracer",
    viewer="read=rosie,trade",
    driver="register=rosie",
    tracer="includes=viewer instrument=trade",
)


def test_tracing_takes_the_right_to_instrument_and_reading_the_right_to_read(
    memory: MemorySystem, tmp_path: Path
) -> None:
    path = tmp_path / "policy.toml"
    path.write_text(POLICY)
    dash, drv, chief = (memory.container(name, identity=name) for name in ("dash", "drv", "chief"))
    for container in (dash, drv, chief):
        container.load_policy(path)
    memory.settle()
    with pytest.raises(AccessDenied, match=r"dash may not instrument trade.set_tracing"):
        dash.set_tracing(True)
    assert chief.set_tracing(True) == ["chief", "dash", "drv"]
    assert dash.spans() == []
    with pytest.raises(AccessDenied, match=r"drv may not read trade.spans"):
        drv.spans()
    with pytest.raises(AccessDenied, match=r"drv may not read trade.log_lines"):
        drv.logs()
