"""What goes over the wire: garbage is dropped, counted, logged once; forgeries are ignored; nothing else stops."""

import logging
import threading
from collections.abc import Iterator
from typing import Any, Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.trade.forged_messages import FORGED, FUTURE, PROVIDER, TEXT, FakeCallee
from trade import Container, Secret, service, where
from trade._discovery.announcer import Announcer
from trade.protocol import messages
from trade.protocol.keys import (
    Address,
    alive_key,
    as_chunk,
    call_key,
    calls_to,
    is_chunk,
    registry_key,
    reply_key,
    tally_key,
)
from trade.protocol.messages import (
    EMPTY,
    EMPTY_ARGUMENTS,
    PROTOCOL,
    Call,
    Malformed,
    ProviderInfo,
    Reply,
    ServiceInfo,
    Status,
    Tally,
    decode_call,
    decode_provider,
    decode_reply,
    encode_message,
)
from trade.testing._ear import RecordingListener, RegistryResponder

CALL = Call(PROTOCOL, 7, "echo", "raw/0", "tester/raw/0", 2**62, (), EMPTY_ARGUMENTS)
REPLY = Reply(PROTOCOL, 7, Status.OK, 1, EMPTY)


class Echo:
    def __init__(self) -> None:
        self.runs = 0

    @service(effect="read")
    def echo(self, value: int = 0) -> int:
        self.runs += 1
        return value

    @service(effect="stop")
    def stop(self) -> None:
        self.runs += 1


_plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5) | st.binary(),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(max_size=8), inner, max_size=5),
    max_leaves=20,
)
_bytes = (
    st.binary(max_size=200)
    | _plain.map(msgspec.msgpack.encode)
    | st.lists(_plain, min_size=5, max_size=9).map(lambda rest: msgspec.msgpack.encode([PROTOCOL, *rest]))
)
_DECODERS = [decode_call, decode_reply, decode_provider]


@pytest.mark.parametrize("decode", _DECODERS, ids=lambda decode: decode.__name__)
@given(data=_bytes)
def test_any_bytes_are_a_message_or_malformed(decode: Any, data: bytes) -> None:
    try:
        decode(data)
    except Malformed as bad:
        assert str(bad)


@pytest.mark.parametrize("decode", _DECODERS, ids=lambda decode: decode.__name__)
@pytest.mark.parametrize("message", [CALL, REPLY, PROVIDER], ids=["call", "reply", "provider"])
@given(st.data())
def test_a_message_with_damaged_bytes_is_a_message_or_malformed(decode: Any, message: Any, data: st.DataObject) -> None:
    good = bytearray(encode_message(message))
    for _ in range(data.draw(st.integers(1, 4))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    try:
        decode(bytes(good[: data.draw(st.integers(0, len(good)))]))
    except Malformed:
        return


DEEP = [b"\x91" * 100_000, b"\x81\xa1a" * 100_000, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"", b"\xc1"]


@pytest.mark.parametrize("decode", _DECODERS, ids=lambda decode: decode.__name__)
@pytest.mark.parametrize("data", DEEP, ids=lambda data: data[:6].hex() or "empty")
def test_hostile_nesting_and_lengths_are_malformed(decode: Any, data: bytes) -> None:
    inside = encode_message(CALL)[:-1] + data  # also where anything may stand
    for hostile in (data, inside, b"\x98\x01\x07" + data, b"\x86\xa1v\x01\xa8services" + data):
        with pytest.raises(Malformed):
            decode(hostile)


@pytest.mark.parametrize("decode", _DECODERS, ids=lambda decode: decode.__name__)
def test_what_is_larger_than_any_message_is_not_decoded(decode: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(messages, "_MOST_MESSAGE_BYTES", 1000)
    with pytest.raises(Malformed, match="a message of 1001 bytes exceeds the limit"):
        decode(bytes(1001))


@pytest.mark.parametrize("message", [CALL, REPLY, PROVIDER], ids=["call", "reply", "provider"])
def test_another_version_of_the_protocol_is_malformed_and_says_so(message: Any) -> None:
    decode = {Call: decode_call, Reply: decode_reply, ProviderInfo: decode_provider}[type(message)]
    future = msgspec.structs.replace(message, v=FUTURE)
    with pytest.raises(Malformed, match=f"protocol version {FUTURE}, this is {PROTOCOL}; update the older side"):
        decode(encode_message(future))


@pytest.mark.parametrize("message", [CALL, REPLY, PROVIDER], ids=["call", "reply", "provider"])
def test_messages_survive_the_wire(message: Any) -> None:
    decode = {Call: decode_call, Reply: decode_reply, ProviderInfo: decode_provider}[type(message)]
    assert encode_message(decode(encode_message(message))) == encode_message(message)


def test_an_effect_that_is_not_known_counts_as_actuating() -> None:
    odd = ServiceInfo(name="turn", signature="turn()", effect="servo")
    reported = ProviderInfo(revision=1, groups=("rosie",), kind="Arm", host="here", pid=1, services=(odd,))
    [read] = decode_provider(encode_message(reported)).services
    assert read.effect == "actuate"


@pytest.mark.parametrize("status", [-1, 9, 99])
def test_a_reply_of_an_unknown_status_is_malformed(status: int) -> None:
    with pytest.raises(Malformed):
        decode_reply(encode_message(Reply(PROTOCOL, 7, status, 1, EMPTY)))


@given(st.text(max_size=100))
def test_any_text_can_be_made_a_chunk_of_a_key(text: str) -> None:
    assert is_chunk(as_chunk(text))


@pytest.mark.parametrize("text", ["", "*", "a*", "a/b", "a$", "@a", "a b", "a" * 81, "ä", "a?", "a#"])
def test_what_could_be_a_pattern_is_no_chunk(text: str) -> None:
    assert not is_chunk(text)


def test_each_identity_is_a_chunk_of_its_own() -> None:
    callee = Address("arm", "driver", "e1")
    assert call_key("me", callee, "rosie", "Arm-1", stop=False) == "call/me/arm/driver/e1/rosie/Arm-1"
    assert call_key("me", callee, "rosie", "Arm-1", stop=True) == "stop/me/arm/driver/e1/rosie/Arm-1"
    assert calls_to(callee, stop=False) == "call/*/arm/driver/e1/**"
    assert reply_key("arm", "me", "laptop", "0") == "reply/arm/me/laptop/0"
    assert registry_key("rosie", callee, "Arm-1") == "registry/rosie/arm/driver/e1/Arm-1"
    assert alive_key(callee) == "alive/arm/driver/e1"


@pytest.fixture
def echo(here: Container) -> Echo:
    echo = Echo()
    here.register(echo, "robot")
    return echo


def key_of(container: Container, name: str) -> Any:
    return container.find(where(name=name, container=container.name)).key


def still_works(container: Container, raw: Any) -> bool:
    """A proper call from elsewhere is answered properly."""
    key = key_of(container, "echo")
    replies = raw.subscribe(reply_key(container.address.identity, "tester", "raw", "0"))
    raw.publish(call_key("tester", key.address, key.domain, key.provider, stop=False)).put(encode_message(CALL))
    return decode_reply(replies.receive().payload or b"").status == Status.OK


BAD_CALLS = {
    "garbage": b"garbage",
    "empty": b"",
    "future": encode_message(msgspec.structs.replace(CALL, v=FUTURE)),
    "short": encode_message([PROTOCOL, 7]),
    "pattern as reply container": encode_message(msgspec.structs.replace(CALL, reply="*/0")),
    "pattern as reply channel": encode_message(msgspec.structs.replace(CALL, reply="raw/**")),
    "no reply": encode_message(msgspec.structs.replace(CALL, reply="")),
    "reply elsewhere": encode_message(msgspec.structs.replace(CALL, reply="raw/0/more")),
}


@pytest.mark.parametrize("payload", BAD_CALLS.values(), ids=list(BAD_CALLS))
@pytest.mark.parametrize("kind", ["call", "stop"])
def test_a_malformed_call_is_dropped_counted_and_never_run(
    here: Container, echo: Echo, open_raw: Any, eventually: Any, payload: bytes, kind: str
) -> None:
    raw = open_raw(here)
    key = key_of(here, "echo" if kind == "call" else "stop")
    raw.publish(call_key("tester", key.address, key.domain, key.provider, stop=kind == "stop")).put(payload)
    assert eventually(lambda: here.dropped_messages == 1)
    assert echo.runs == 0
    assert still_works(here, raw)


BAD_KEYS = {
    "every container": "call/tester/*/*/*/robot/{provider}",
    "every boot": "call/tester/{identity}/{container}/*/robot/{provider}",
    "every kind": "*/tester/{address}/robot/{provider}",
    "any caller": "call/*/{address}/robot/{provider}",
    "everything": "**",
    "everything of its kind": "call/**",
}


@pytest.mark.parametrize("pattern", BAD_KEYS.values(), ids=list(BAD_KEYS))
def test_a_call_to_a_pattern_is_dropped_and_never_run(
    here: Container, echo: Echo, open_raw: Any, eventually: Any, pattern: str
) -> None:
    raw = open_raw(here)
    key = key_of(here, "echo")
    parts = {"identity": key.address.identity, "container": key.address.container, "provider": key.provider}
    raw.publish(pattern.format(address=key.address, **parts)).put(encode_message(CALL))
    assert eventually(lambda: here.dropped_messages >= 1)
    assert echo.runs == 0
    assert still_works(here, raw)


GONE = {
    "no such provider": ("robot", "Echo-99", "echo", False),
    "no such service": ("robot", None, "fly", False),
    "under a domain of others": ("public", None, "echo", False),
    "a pattern for a provider": ("robot", "**", "echo", False),
    "a reading service as a stop": ("robot", None, "echo", True),
    "a stop as a call": ("robot", None, "stop", False),
}


def test_a_flood_of_nonsense_is_counted_while_calls_continue(
    here: Container, there: Container, open_raw: Any, eventually: Any
) -> None:
    there.register(Echo(), "robot")
    echo = here.find(where(name="echo", container="there"), wait_s=20)
    raw = open_raw(here, there)
    calls = raw.publish(call_key("tester", echo.key.address, "robot", echo.key.provider, stop=False))
    entries = raw.publish(registry_key("robot", Address("tester", "flood", "e1"), "Arm-1"))
    done = threading.Event()

    def flood() -> None:
        for _ in range(5000):
            calls.put(b"garbage")
            entries.put(b"garbage")
        done.set()

    flooding = threading.Thread(target=flood)
    flooding.start()
    answered = 0
    while not done.is_set():
        assert echo(7) == 7
        answered += 1
    flooding.join(60)
    assert answered > 0
    assert eventually(lambda: there.dropped_messages == 10_000)
    assert echo(7) == 7


@pytest.mark.parametrize(("domain", "provider", "name", "as_stop"), GONE.values(), ids=list(GONE))
def test_a_call_of_what_is_not_there_is_answered_so(
    here: Container, echo: Echo, open_raw: Any, domain: str, provider: str | None, name: str, as_stop: bool
) -> None:
    raw = open_raw(here)
    key = key_of(here, "echo")
    replies = raw.subscribe(reply_key(here.address.identity, "tester", "raw", "0"))
    raw.publish(call_key("tester", key.address, domain, provider or key.provider, stop=as_stop)).put(
        encode_message(msgspec.structs.replace(CALL, service=name))
    )
    assert decode_reply(replies.receive().payload or b"").status == Status.GONE
    assert echo.runs == 0


def test_arguments_that_are_no_arguments_are_invalid(here: Container, echo: Echo, open_raw: Any) -> None:
    raw = open_raw(here)
    key = key_of(here, "echo")
    replies = raw.subscribe(reply_key(here.address.identity, "tester", "raw", "0"))
    publisher = raw.publish(call_key("tester", key.address, key.domain, key.provider, stop=False))
    strange = [5, "text", None, b"", {1: 2}, [msgspec.msgpack.Ext(99, b"x")], [msgspec.msgpack.Ext(1, b"x")]]
    for args in strange:
        publisher.put(encode_message(msgspec.structs.replace(CALL, args=msgspec.Raw(encode_message(args)))))
        reply = decode_reply(replies.receive().payload or b"")
        assert reply.status == Status.ERROR
        assert msgspec.msgpack.decode(reply.body)["type"] == "trade.errors:InvalidArgument"
    assert echo.runs == 0


class Safe:
    @service(effect="read")
    def unlock(self, code: Secret[str]) -> bool:
        return False


DEEPER: Final = [b"\x91" * depth + b"\xc0" for depth in (100, *range(850, 1000))]


@pytest.mark.parametrize("name", ["echo", "unlock"])
def test_arguments_however_deep_are_refused_and_answered_also_where_one_is_secret(
    here: Container, echo: Echo, open_raw: Any, eventually: Any, name: str
) -> None:
    here.register(Safe(), "desk")
    raw = open_raw(here)
    key = key_of(here, name)
    replies = RecordingListener(raw.subscribe(reply_key(here.address.identity, "tester", "raw", "0")))
    publisher = raw.publish(call_key("tester", key.address, key.domain, key.provider, stop=False))
    strange = [b"\x91\xa1\xff", *(encode_message(value) for value in (5, "text", None, b"", {1: 2})), *DEEPER]
    for number, args in enumerate(strange):
        publisher.put(encode_message(msgspec.structs.replace(CALL, id=number, service=name, args=msgspec.Raw(args))))
    assert eventually(lambda: replies._messages.qsize() + here.dropped_messages == len(strange))
    for _ in range(replies._messages.qsize()):
        reply = decode_reply(replies.next().payload or b"")
        assert msgspec.msgpack.decode(reply.body)["type"] == "trade.errors:InvalidArgument"
    assert echo.runs == 0


def test_malformed_messages_are_logged_once_and_counted(
    here: Container, echo: Echo, open_raw: Any, eventually: Any, caplog: pytest.LogCaptureFixture
) -> None:
    raw = open_raw(here)
    key = key_of(here, "echo")
    publisher = raw.publish(call_key("tester", key.address, key.domain, key.provider, stop=False))
    with caplog.at_level(logging.DEBUG, "trade"):
        for _ in range(20):
            publisher.put(encode_message(msgspec.structs.replace(CALL, v=FUTURE)))
        assert eventually(lambda: here.dropped_messages == 20)
    [record] = [record for record in caplog.records if "dropped" in record.message]
    assert f"protocol version {FUTURE}" in record.message
    assert "further ones are counted, not logged" in record.message


BAD_ENTRIES = {
    "garbage": (registry_key("robot", FORGED, "P-1"), b"garbage"),
    "future": (registry_key("robot", FORGED, "P-1"), encode_message(msgspec.structs.replace(PROVIDER, v=FUTURE))),
    "short key": ("registry/robot/mallory", encode_message(PROVIDER)),
    "long key": (registry_key("robot", FORGED, "P-1/more"), encode_message(PROVIDER)),
}


@pytest.mark.parametrize(("key", "payload"), BAD_ENTRIES.values(), ids=list(BAD_ENTRIES))
def test_a_malformed_registry_entry_is_dropped_and_counted(
    here: Container, echo: Echo, open_raw: Any, eventually: Any, key: str, payload: bytes
) -> None:
    raw = open_raw(here)
    ghost = raw.appear(alive_key(FORGED))
    raw.announce(key, payload)
    assert eventually(lambda: here.dropped_messages >= 1)
    assert here.services(where(group="forged")) == []
    assert still_works(here, raw)
    ghost.close()


def test_an_entry_under_a_pattern_never_makes_a_service(
    here: Container, echo: Echo, open_raw: Any, eventually: Any
) -> None:
    """Calling it would send the call to all containers."""
    raw = open_raw(here)
    raw.publish("registry/robot/*/*/*/P-1").put(encode_message(PROVIDER))
    assert eventually(lambda: here.dropped_messages == 1)
    assert here.services(where(group="forged")) == []
    assert still_works(here, raw)


def test_a_late_joiner_survives_malformed_entries_in_the_registry(
    here: Container, start_container: Any, open_raw: Any, echo: Echo
) -> None:
    raw = open_raw(here)
    standing = {
        registry_key("robot", FORGED, "P-1"): b"garbage",
        registry_key("robot", FORGED, "P-2"): encode_message(msgspec.structs.replace(PROVIDER, v=FUTURE)),
        registry_key("robot", FORGED, "P-3"): encode_message(PROVIDER),
        tally_key(FORGED): encode_message(Tally(PROTOCOL, 3)),
    }
    RegistryResponder(raw, registry_key("*", FORGED, "*"), standing)
    _sign = raw.appear(alive_key(FORGED))
    late = start_container("late")
    assert late.find(where(name="echo"), wait_s=20)(3) == 3
    assert late.find(where(group="forged"), wait_s=20).key.provider == "P-3"
    assert late.dropped_messages == 2


@pytest.fixture
def announcer(here: Container, open_raw: Any) -> Iterator[tuple[Any, Announcer]]:
    """A bare transport linked with the container, and what announces there for an address of no container."""
    raw = open_raw(here)
    announcing = Announcer(raw, FORGED)
    yield raw, announcing
    announcing.close()


def test_entries_count_only_while_their_container_shows_itself(
    here: Container, announcer: tuple[Any, Announcer], eventually: Any
) -> None:
    raw, announcing = announcer
    announcing.announce("robot", "P-1", PROVIDER)
    raw.announce(registry_key("robot", FORGED, "P-1"), encode_message(PROVIDER))
    assert here.services(where(group="forged")) == []
    sign = announcing.appear()
    assert here.find(where(group="forged"), wait_s=20).container == "ghost"
    sign.close()
    assert eventually(lambda: here.services(where(group="forged")) == [])
    assert FORGED not in here._parts.registry._containers


def test_a_newer_revision_of_an_entry_replaces_it_and_an_older_one_does_not(
    here: Container, announcer: tuple[Any, Announcer], eventually: Any
) -> None:
    raw, announcing = announcer
    _sign = announcing.appear()
    announcing.announce("robot", "P-1", PROVIDER)
    handle = here.find(where(group="forged"), wait_s=20)
    announcing.announce("robot", "P-1", msgspec.structs.replace(PROVIDER, revision=3, groups=("newer",)))
    assert here.find(where(group="newer"), wait_s=20) == handle
    older = msgspec.structs.replace(PROVIDER, revision=2, groups=("older",))
    raw.announce(registry_key("robot", FORGED, "P-1"), encode_message(older))
    announcing.announce("robot", "P-1", msgspec.structs.replace(PROVIDER, revision=4, groups=("newest",)))
    assert here.find(where(group="newest"), wait_s=20).groups == ("newest",)
    assert here.services(where(group="older")) == here.services(where(group="forged")) == []


def test_an_answer_on_behalf_of_another_container_is_ignored(
    here: Container, start_container: Any, open_raw: Any, eventually: Any
) -> None:
    here.register(Echo(), "robot")
    raw = open_raw(here)
    standing = {
        registry_key("robot", FORGED, "P-1"): encode_message(PROVIDER),
        registry_key("robot", here.address, "P-1"): encode_message(PROVIDER),
        tally_key(FORGED): encode_message(Tally(PROTOCOL, 3)),
        tally_key(here.address): encode_message(Tally(PROTOCOL, 3)),
    }
    RegistryResponder(raw, "registry/**", standing)
    _sign = raw.appear(alive_key(FORGED))
    late = start_container("late")  # asks all containers
    assert late.dropped_messages == 1
    assert late.find(where(name="echo", group="robot"), wait_s=20)(3) == 3
    [forged] = late.services(where(group="forged")) or [late.find(where(group="forged"), wait_s=20)]
    assert forged.key.address == FORGED  # that one was asked alone, then


def test_a_flood_of_entries_ends_at_a_limit_and_disturbs_no_other(
    here: Container,
    there: Container,
    announcer: tuple[Any, Announcer],
    monkeypatch: pytest.MonkeyPatch,
    eventually: Any,
) -> None:
    monkeypatch.setattr("trade._registry.registry._MOST_PROVIDERS", 100)
    raw, _ = announcer
    _sign = raw.appear(alive_key(FORGED))
    assert eventually(lambda: FORGED in here._parts.registry._containers)
    for number in range(2000):
        entry = msgspec.structs.replace(PROVIDER, revision=3 * number + 1)
        raw.announce(registry_key("robot", FORGED, f"P-{number}"), encode_message(entry))
    there.register(Echo(), "other")
    assert here.find(where(name="echo", group="other"), wait_s=20)(3) == 3
    assert len(here.services(where(group="forged"))) <= 100


def test_a_call_goes_by_the_newest_description_of_its_service(here: Container, open_raw: Any) -> None:
    callee = FakeCallee(open_raw(here), here)
    first = callee.handle.start()
    callee.answer_clock()
    callee.answer(callee.next(), Status.OK, 5)
    assert first.result(20) == 5
    info = ServiceInfo(name="go", signature="go() -> str", effect="read", result_schema=TEXT)
    callee.describe(msgspec.structs.replace(PROVIDER, revision=2, services=(info,), groups=("newer",)))
    assert here.find(where(group="newer"), wait_s=20) == callee.handle
    second = callee.handle.start()
    callee.answer(callee.next(), Status.OK, "text")
    assert second.result(20) == "text"
    assert callee.handle.signature == "go() -> str"
