"""What a call may cost, counted instead of timed: messages, lookups, things built again, allocations."""

import contextlib
import gc
import sys
import tracemalloc
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from msgspec import structs

import trade._services.signature as signatures
from tests.support.waiting import wait_until
from trade import Container, Handle, Settings, service, where
from trade._calls.arguments import ArgumentEncoder
from trade._discovery.host_folder import HostFolder
from trade._registry.registry import Registry
from trade.errors import InvalidArgument
from trade.protocol.keys import TALLY, Address
from trade.protocol.messages import PROTOCOL, Call, ProviderInfo, ServiceInfo, decode_provider, encode_message
from trade.transport.base import Publisher
from trade.transport.endpoints import free_endpoint
from trade.transport.zenoh import ZenohTransport, configuration

CALLS = 20
MOST_BYTES_OF_A_CALL = 16 * 1024
MOST_BLOCKS_KEPT = 100
MANY_BYTES = 8 << 20


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

    def announce(self, key: str, payload: bytes) -> None:
        self._sent["registry"] += not key.endswith(f"/{TALLY}")  # that comes with time, whatever happens
        super().announce(key, payload)

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
            rendezvous, endpoint = HostFolder(system), free_endpoint()
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


def test_a_call_is_two_messages_under_a_policy_too(
    pair: tuple[Container, Container], sent: Counter[str], tmp_path: Path
) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text('[roles.all]\ncall = ["*"]\nregister = ["*"]\n[identities]\n"*" = ["all"]\n')
    here, there = pair
    for container in pair:
        container.load_policy(policy)
    there.register(Arm(), "robot")
    move = here.find(where(name="move", group="robot"), wait_s=20)
    move(0.1, 0.2, 0.3)
    sent.clear()
    for _ in range(CALLS):
        move(0.1, 0.2, 0.3)
    assert sent == {"call": CALLS, "reply": CALLS}


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


def test_objects_of_one_class_share_what_their_methods_say(here: Container, monkeypatch: pytest.MonkeyPatch) -> None:
    read = counted(monkeypatch, signatures.Signature, "__init__")
    handles = [handle for number in range(CALLS) for handle in here.register(Arm(), f"robot.p{number}")]
    assert read["__init__"] == len(CALL)
    with pytest.raises(InvalidArgument, match=r"robot[.]p7[.]move"):
        handles[7 * len(CALL)]("text", 0.2, 0.3)


def test_what_objects_share_goes_with_the_last_of_them(here: Container) -> None:
    class Passing(Arm):
        @service
        def rest(self, place: float) -> None: ...

    robots = [Passing(), Passing()]
    for robot in robots:
        here.register(robot, "robot")
    for robot in robots:
        here.deregister(robot)
    left = weakref.ref(Passing)
    del Passing, robots, robot
    gc.collect()
    assert left() is None


def test_a_class_that_has_changed_is_read_again(here: Container) -> None:
    class Changing:
        @service
        def move(self, angle_rad: float) -> float:
            return angle_rad

    changing, same = Changing(), Changing()
    move, _ = (*here.register(changing, "robot"), *here.register(same, "robot.other"))
    Changing.move.__doc__ = "As it is now."
    here.alter(changing)
    assert move.doc == "As it is now."


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


@pytest.mark.realtime  # other threads may ask it about a container that has just joined
@pytest.mark.parametrize("name", CALL)
def test_the_registry_is_not_asked_by_later_calls(
    offer: Callable[..., Callable[[str], Handle]], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    asked = counted(monkeypatch, Registry, "get", "select", "wait_for", "is_alive", "containers", "removed")
    handle, call = offer(Arm())(name), CALL[name]
    call(handle)
    assert asked  # to find it, and to see that it exists
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


@pytest.mark.parametrize(("name", "most"), [("straight", 12), ("move", 20), ("where_is", 20)])
def test_a_local_call_that_inherits_nothing_runs_few_functions(here: Container, name: str, most: int) -> None:
    class Direct(Arm):
        @service(strict=False)
        def straight(self, a: float, b: float, c: float) -> float:
            return a

    handles = {handle.name: handle for handle in here.register(Direct(), "robot")}
    call = CALL["move" if name == "straight" else name]
    call(handles[name])
    assert functions_run(lambda: call(handles[name])) <= most


def test_large_arguments_are_copied_once_into_their_message() -> None:
    data = bytes(MANY_BYTES)
    info = ServiceInfo(name="keep", signature="keep(data: bytes)")
    codec = signatures.Codec(lambda value: value, lambda code, inside: inside)
    encoder = ArgumentEncoder(codec, info, "robot.keep")
    call = Call(PROTOCOL, 1, "keep", "c/0", "", None, (), cast(Any, (data,)))
    with traced():
        assert peak_bytes(lambda: encoder.encode_call(call)) < 1.9 * MANY_BYTES


MANY = 200
MOST_BYTES_OF_A_SERVICE = 1024


def entries(here: Container, count: int) -> list[bytes]:
    """What so many arms say of themselves, as it travels."""
    services = tuple(handle.record.info for handle in here.register(Arm(), "robot"))
    said = ProviderInfo(revision=1, groups=("robot",), kind="Arm", host="edge", pid=1, services=services)
    return [encode_message(structs.replace(said, groups=(f"robot.p{number}",))) for number in range(count)]


def test_equal_services_are_one_object_however_many_announce_them(here: Container) -> None:
    first, second = map(decode_provider, entries(here, 2))
    assert first.groups != second.groups
    assert all(one is other for one, other in zip(first.services, second.services, strict=True))
    assert (first.kind is second.kind, first.host is second.host) == (True, True)
    left = [weakref.ref(service) for service in first.services]
    del first, second
    wait_until(lambda: [ref() for ref in left] == [None] * len(CALL))  # another thread may hold one for a moment


def test_a_service_of_another_container_weighs_little(here: Container) -> None:
    registry, said = Registry(Address("me", "late", "e1")), entries(here, MANY)
    with traced():
        before, _ = tracemalloc.get_traced_memory()
        registry.appear(Address("me", "driver", "e2"))
        for number, entry in enumerate(said):
            registry.put(Address("me", "driver", "e2"), "robot", f"Arm-{number}", decode_provider(entry))
        grown = tracemalloc.get_traced_memory()[0] - before
    assert len(registry.select(where())) == MANY * len(CALL)
    assert grown <= MOST_BYTES_OF_A_SERVICE * MANY * len(CALL)


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


def functions_run(action: Callable[[], object]) -> int:
    """How many functions of Python it runs, on this thread, itself left out."""
    run: list[str] = []
    sys.setprofile(lambda frame, event, _: run.append(frame.f_code.co_name) if event == "call" else None)
    try:
        action()
    finally:
        sys.setprofile(None)
    return len(run) - 2  # the action and what it calls here


def blocks() -> int:
    return sum(trace.count for trace in tracemalloc.take_snapshot().statistics("filename"))
