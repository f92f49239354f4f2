"""What a call may cost, counted instead of timed: messages, lookups, things built anew, allocations."""

import contextlib
import gc
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import trade._signature as signatures
from trade import Container, Handle, Settings, service, where
from trade._registry import Registry
from trade._rendezvous import Rendezvous, free_endpoint
from trade._transport import Publisher
from trade._zenoh import ZenohTransport, configuration

CALLS = 20
MOST_BYTES_OF_A_CALL = 16 * 1024
MOST_BLOCKS_KEPT = 100


class Arm:
    @service
    def move(self, shoulder_rad: float, elbow_rad: float, speed_rad_s: float) -> float:
        return shoulder_rad

    @service(effect="read")
    def where_is(self, *, joint: str) -> dict[str, float]:
        return {joint: 0.5}

    @service(effect="stop")
    def stop(self) -> None: ...


CALL: dict[str, Callable[[Handle], Any]] = {
    "move": lambda handle: handle(0.1, 0.2, 0.3),
    "where_is": lambda handle: handle(joint="elbow"),
    "stop": lambda handle: handle(),
}


class Counted(Publisher):
    """A publisher whose messages are counted by the first chunk of their key."""

    def __init__(self, publisher: Publisher, kind: str, sent: Counter[str]) -> None:
        self._publisher = publisher
        self._kind = kind
        self._sent = sent

    def put(self, payload: bytes) -> None:
        self._sent[self._kind] += 1
        self._publisher.put(payload)

    def close(self) -> None:
        self._publisher.close()


class CountingTransport(ZenohTransport):
    """The real transport, with every message it sends counted."""

    def __init__(self, settings: dict[str, Any], sent: Counter[str]) -> None:
        super().__init__(settings)
        self._sent = sent

    def publish(self, key: str, *, urgent: bool = False, droppable: bool = False) -> Publisher:
        return Counted(
            super().publish(key, urgent=urgent, droppable=droppable), key.split("/", maxsplit=1)[0], self._sent
        )

    def announce(self, key: str) -> Publisher:
        return Counted(super().announce(key), "registry", self._sent)

    def wake(self, key: str, payload: bytes) -> None:
        self._sent["wake"] += 1
        super().wake(key, payload)


@pytest.fixture
def sent() -> Counter[str]:
    return Counter()


@pytest.fixture
def pair(system: str, sent: Counter[str]) -> Iterator[tuple[Container, Container]]:
    """A container that calls and one that provides; what both send is counted."""
    with contextlib.ExitStack() as stack:

        def start(name: str) -> Container:
            rendezvous, endpoint = Rendezvous(system), free_endpoint()
            stack.callback(rendezvous.leave)
            others = rendezvous.enter(endpoint)
            settings = configuration(
                namespace=system, listen=[endpoint], connect=others, credentials=("costs", "secret")
            )
            return stack.enter_context(
                Container(Settings.read(container=name), transport=CountingTransport(settings, sent))
            )

        yield start("here"), start("there")


@pytest.mark.parametrize("name", CALL)
def test_a_call_is_two_messages_once_the_first_one_was_made(
    pair: tuple[Container, Container], sent: Counter[str], name: str
) -> None:
    here, there = pair
    there.register(Arm(), "robot")
    handle, call = here.find(where(name=name, group="robot"), wait_s=20), CALL[name]
    call(handle)
    sent.clear()
    for _ in range(CALLS):
        call(handle)
    request = "stop" if name == "stop" else "call"
    assert sent == {request: CALLS, "reply": CALLS}


def test_a_started_call_is_two_messages_too(pair: tuple[Container, Container], sent: Counter[str]) -> None:
    here, there = pair
    there.register(Arm(), "robot")
    move = here.find(where(name="move", group="robot"), wait_s=20)
    move.start(0.1, 0.2, 0.3).result(20)
    sent.clear()
    for run in [move.start(0.1, 0.2, 0.3) for _ in range(CALLS)]:
        run.result(20)
    assert sent == {"call": CALLS, "reply": CALLS}


def test_a_local_call_sends_nothing(pair: tuple[Container, Container], sent: Counter[str]) -> None:
    here, _ = pair
    move, *_ = here.register(Arm(), "robot")
    sent.clear()
    for _ in range(CALLS):
        move(0.1, 0.2, 0.3)
    assert not sent


def test_a_provider_is_announced_once(pair: tuple[Container, Container], sent: Counter[str]) -> None:
    _, there = pair
    sent.clear()
    there.register(Arm(), "robot")
    assert sent == {"registry": 1}


def test_signatures_are_read_at_registration_and_never_again(
    offer: Callable[..., Callable[[str], Handle]], monkeypatch: pytest.MonkeyPatch
) -> None:
    read = counted(monkeypatch, signatures.Signature, "__init__")
    find = offer(Arm())
    assert read["__init__"] == len(CALL)
    for name, call in CALL.items():
        call(find(name))
    assert read["__init__"] == len(CALL)


@pytest.mark.parametrize("name", CALL)
def test_decoders_are_made_before_the_second_call(
    offer: Callable[..., Callable[[str], Handle]], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    made = counted(monkeypatch, signatures.Codec, "decoder")
    handle, call = offer(Arm())(name), CALL[name]
    call(handle)
    assert made  # of the arguments and the result
    made.clear()
    for _ in range(CALLS):
        call(handle)
    assert not made


@pytest.mark.parametrize("name", CALL)
def test_the_registry_is_not_asked_by_later_calls(
    offer: Callable[..., Callable[[str], Handle]], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    asked = counted(monkeypatch, Registry, "get", "select", "wait_for", "is_alive", "containers", "removed")
    handle, call = offer(Arm())(name), CALL[name]
    call(handle)
    assert asked  # to find it, and to see that it is there
    asked.clear()
    for _ in range(CALLS):
        call(handle)
    assert not asked


def test_a_local_call_allocates_little_and_keeps_nothing(here: Container) -> None:
    handles = {handle.name: handle for handle in here.register(Arm(), "robot")}
    for name, call in CALL.items():
        call(handles[name])
    with traced():
        for name, call in CALL.items():
            call(handles[name])
            assert peak_bytes(lambda name=name, call=call: call(handles[name])) <= MOST_BYTES_OF_A_CALL
        before = blocks()
        for _ in range(50 * CALLS):
            CALL["move"](handles["move"])
        assert blocks() - before <= MOST_BLOCKS_KEPT


def counted(monkeypatch: pytest.MonkeyPatch, owner: type, *names: str) -> Counter[str]:
    """Count the calls of methods from now on; they do what they did."""
    calls: Counter[str] = Counter()

    def count(name: str) -> None:
        method = getattr(owner, name)

        def counting(*args: Any, **kwargs: Any) -> Any:
            calls[name] += 1
            return method(*args, **kwargs)

        monkeypatch.setattr(owner, name, counting)

    for name in names:
        count(name)
    return calls


@contextlib.contextmanager
def traced() -> Iterator[None]:
    gc.collect()
    gc.disable()
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()
        gc.enable()


def peak_bytes(action: Callable[[], object]) -> int:
    """How much memory an action holds at a time, above what was there before."""
    tracemalloc.reset_peak()
    before, _ = tracemalloc.get_traced_memory()
    action()
    return tracemalloc.get_traced_memory()[1] - before


def blocks() -> int:
    return sum(trace.count for trace in tracemalloc.take_snapshot().statistics("filename"))
