"""A live provider changes groups, metadata, health, services; handles hold and all containers learn the newest."""

import queue
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trade
from trade import Container, Handle, service, where
from trade.errors import ConfigurationError
from trade.protocol.messages import Malformed, ProviderInfo, decode_provider, encode_message

pytestmark = pytest.mark.virtual_time

Eventually = Callable[[Callable[[], bool]], bool]


class Motor:
    def __init__(self) -> None:
        self.resources = ("joint",)

    @service(meta={"payload_kg": 2, "side": "left"})
    def move(self, angle_rad: float) -> float:
        return angle_rad

    @service(effect="stop")
    def stop(self) -> None: ...


class DynamixelMotor(Motor): ...


@pytest.fixture
def motor(there: Container) -> Motor:
    motor = DynamixelMotor()
    there.register(motor, "rosie.neck", meta={"side": "right"})
    return motor


@pytest.fixture
def move(here: Container, motor: Motor) -> Handle:
    return here.find(where(name="move", kind="Motor"), wait_s=20)


@pytest.fixture
def heard(here: Container, move: Handle) -> "queue.SimpleQueue[Handle]":
    heard: queue.SimpleQueue[Handle] = queue.SimpleQueue()
    here.changed(where(name="move"), heard.put)
    return heard


Heard = Any


def test_kinds_metadata_and_health_are_known_elsewhere(move: Handle) -> None:
    assert move.kinds == ("DynamixelMotor", "Motor")
    assert dict(move.meta) == {"payload_kg": 2, "side": "right"}
    assert (move.health, move.achieves) == ("healthy", ())


def test_groups_of_a_live_provider_change_and_handles_hold(
    here: Container, there: Container, motor: Motor, move: Handle, heard: Heard
) -> None:
    there.set_groups(motor, ["lab.bench", "spare"])
    assert heard.get(timeout=20) == move
    assert (move.groups, move.label) == (("lab.bench", "spare"), "lab.bench.move")
    assert here.find(where(name="move", group="lab")) == move
    assert here.services(where(group="rosie")) == []
    assert (move.key.domain, move(0.5)) == ("rosie.neck", 0.5)


def test_single_groups_come_and_go(there: Container, motor: Motor, move: Handle, heard: Heard) -> None:
    there.add_group(motor, "spare")
    there.add_group(motor, "spare")
    heard.get(timeout=20)
    assert move.groups == ("rosie.neck", "spare")
    there.remove_group(motor, "rosie.neck")
    there.remove_group(motor, "nowhere")
    heard.get(timeout=20)
    assert move.groups == ("spare",)
    assert heard.empty()


def test_health_is_shown_on_the_handle_and_usable_as_a_filter(
    here: Container, there: Container, motor: Motor, move: Handle, heard: Heard
) -> None:
    there.set_health(motor, "degraded: overheating")
    heard.get(timeout=20)
    assert move.health == "degraded: overheating"
    assert move in here.services(where(healthy=False))
    assert here.services(where.healthy & where(name="move")) == []
    there.set_health(motor)
    heard.get(timeout=20)
    assert here.services(where(healthy=False)) == []
    assert move(0.5) == 0.5


def test_a_provider_is_read_again(there: Container, motor: Motor, move: Handle, heard: Heard) -> None:
    motor.resources = ("joint", "brake")
    there.alter(motor, meta={"payload_kg": 1})
    heard.get(timeout=20)
    assert dict(move.meta) == {"payload_kg": 1, "side": "left"}
    assert move.resources == ("joint", "brake")
    assert move(0.5) == 0.5


def test_changed_reports_only_services_that_start_or_cease_to_match(
    here: Container, there: Container, motor: Motor, move: Handle, heard: Heard
) -> None:
    healthy: queue.SimpleQueue[str] = queue.SimpleQueue()
    here.changed(where(name="move", healthy=True), lambda handle: healthy.put(handle.health))
    here.changed(where(name="move", group="elsewhere"), lambda handle: healthy.put("wrong"))
    there.set_health(motor, "hot")
    heard.get(timeout=20)
    there.set_health(motor, "hotter")
    heard.get(timeout=20)
    there.set_health(motor)
    heard.get(timeout=20)
    assert healthy.get(timeout=20)
    assert healthy.get(timeout=20) == "healthy"
    assert healthy.empty()


def test_late_joiners_see_the_newest_only(there: Container, motor: Motor, start_container: Any) -> None:
    for degree in range(20):
        there.set_health(motor, f"hot: {degree}")
    late = start_container("late")
    seen: queue.SimpleQueue[str] = queue.SimpleQueue()
    late.joined(where(name="move"), lambda handle: seen.put(handle.health), existing=True)
    assert seen.get(timeout=20) == "hot: 19"
    assert seen.empty()


@pytest.mark.parametrize("wrong", ["", 5, None, "x" * 501])
def test_health_is_a_text_that_says_something(there: Container, motor: Motor, wrong: Any) -> None:
    with pytest.raises(ConfigurationError, match="health must be a text"):
        there.set_health(motor, wrong)


def test_what_is_not_registered_or_malformed_is_refused(there: Container, motor: Motor) -> None:
    with pytest.raises(ConfigurationError, match="not registered in this container"):
        there.set_health(Motor(), "hot")
    with pytest.raises(ConfigurationError, match="is no group"):
        there.set_groups(motor, "trade.system")
    with pytest.raises(ConfigurationError, match="meta maps names"):
        there.alter(motor, meta={"a": [1]})  # type: ignore[dict-item]
    there.deregister(motor)
    with pytest.raises(ConfigurationError, match="not registered in this container"):
        there.alter(motor)


def test_the_functions_of_the_module_do_the_same(monkeypatch: pytest.MonkeyPatch, here: Container) -> None:
    monkeypatch.setattr("trade._container.default._default", here)
    motor, heard = Motor(), queue.SimpleQueue[Handle]()
    trade.changed(where(name="move"), heard.put)
    move = trade.register(motor, "a", meta={"n": 1})[0]
    changes: list[Callable[[], None]] = [
        lambda: trade.set_groups(motor, "b"),
        lambda: trade.add_group(motor, "c"),
        lambda: trade.remove_group(motor, "b"),
        lambda: trade.set_health(motor, "hot"),
        lambda: trade.alter(motor, meta={"n": 2}),
    ]
    for change in changes:
        change()
        assert heard.get(timeout=20) == move
    assert (move.groups, move.health, move.meta["n"]) == (("c",), "hot", 2)


def test_a_consultant_is_left_out_while_it_is_ill(here: Container, there: Container) -> None:
    """A component keeps those knowledge bases it may ask, whatever becomes of them."""

    class KnowledgeBase:
        @service(effect="read", meta={"consultant": True})
        def get_kb_name(self) -> str:
            return "people"

    fit = where(name="get_kb_name", meta={"consultant": True}, healthy=True)
    asked: queue.SimpleQueue[tuple[Handle, ...]] = queue.SimpleQueue()
    consultants: set[Handle] = set()

    def review(handle: Handle) -> None:
        (consultants.add if handle in here.services(fit) else consultants.discard)(handle)
        asked.put(tuple(consultants))

    here.joined(fit, review, existing=True)
    here.changed(fit, review)
    here.left(where(name="get_kb_name"), review)
    base = KnowledgeBase()
    there.register(base, "kb")
    [people] = asked.get(timeout=20)
    there.set_health(base, "degraded: no disk")
    assert asked.get(timeout=20) == ()
    there.set_health(base)
    assert asked.get(timeout=20) == (people,)
    there.deregister(base)
    assert asked.get(timeout=20) == ()


def test_ten_thousand_services_reach_another_container(
    here: Container, there: Container, eventually: Eventually
) -> None:
    many = type("Many", (), {f"s{number}": service(lambda self: None) for number in range(250)})
    for number in range(40):
        there.register(many(), f"rack{number}.slot")
    wanted = where(kind="Many")
    assert eventually(lambda: len(here.services(wanted)) == 10_000)
    assert len(here.services(where(group="rack7"))) == 250
    assert here.find(where(name="s17", group="rack7")).container == "there"


_wire = st.recursive(
    st.none() | st.booleans() | st.integers(-2, 2) | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


@given(st.fixed_dictionaries({}, optional={"meta": _wire, "health": _wire, "kinds": _wire}))
def test_an_entry_with_anything_in_its_new_fields_is_taken_or_dropped(reported: dict[str, Any]) -> None:
    info = ProviderInfo(revision=1, groups=("a",), kind="A", host="h", pid=1, services=())
    plain: dict[str, Any] = msgspec.msgpack.decode(encode_message(info))
    try:
        taken = decode_provider(msgspec.msgpack.encode({**plain, **reported}))
    except Malformed:
        return
    assert decode_provider(encode_message(taken)).groups == ("a",)


def test_an_entry_of_before_has_nothing_wrong() -> None:
    info = ProviderInfo(revision=1, groups=("a",), kind="A", host="h", pid=1, services=())
    plain: dict[str, Any] = msgspec.msgpack.decode(encode_message(info))
    for name in ("meta", "health", "kinds"):
        del plain[name]
    assert decode_provider(msgspec.msgpack.encode(plain)) == info
