"""Replies from somewhere strange: forgeries are ignored, garbage is dropped, and nothing they name is loaded."""

import sys
from typing import Any, Final

import msgspec
import pytest

from tests.unit.trade.forged_messages import FUTURE, FakeCallee
from trade import Container
from trade._calls.handle import handle_codec
from trade._calls.target import result_decoder
from trade.errors import InvalidResult, RemoteError
from trade.protocol.messages import PROTOCOL, Reply, ServiceInfo, Status, encode_message
from trade.protocol.schema import schema_message


@pytest.fixture
def callee(here: Container, open_raw: Any) -> FakeCallee:
    return FakeCallee(open_raw(here), here)


@pytest.fixture(params=["call", "start"])
def asked(request: pytest.FixtureRequest, callee: FakeCallee) -> Any:
    """A call under way at the fake callee: the call as it arrived, and how to wait for its end."""
    import concurrent.futures

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        if request.param == "call":
            future: Any = pool.submit(callee.handle)
        else:
            future = callee.handle.start()
        callee.answer_clock()
        yield callee.next(), lambda: future.result(30)


def test_a_reply_from_another_identity_is_ignored(callee: FakeCallee, asked: Any) -> None:
    call, result = asked
    for status in (Status.OK, Status.GONE, Status.BUSY, Status.TIMED_OUT, Status.LOST, Status.CLOSED):
        callee.answer(call, status, 666, speaker="eve")
    callee.answer(call, Status.OK, 5)
    assert result() == 5


def test_a_callee_cannot_end_a_call_in_the_callers_name(callee: FakeCallee, asked: Any) -> None:
    call, result = asked
    for status in (Status.TIMED_OUT, Status.LOST, Status.CLOSED):
        callee.answer(call, status)
    callee.answer(call, Status.OK, 5)
    assert result() == 5


def test_a_reply_to_a_pattern_is_ignored(here: Container, callee: FakeCallee, asked: Any) -> None:
    call, result = asked
    forged = encode_message(Reply(PROTOCOL, call.id, Status.OK, 1, msgspec.Raw(encode_message(666))))
    callee.raw.publish("reply/**").put(forged)
    callee.raw.publish(f"*/mallory/{here.address.identity}/{call.reply}").put(forged)
    callee.answer(call, Status.OK, 5)
    assert result() == 5


def test_a_reply_to_another_call_is_ignored(callee: FakeCallee, asked: Any) -> None:
    call, result = asked
    callee.answer(call, Status.OK, 666, id=call.id + 1)
    callee.answer(call, Status.OK, 666, id=0)
    callee.answer(call, Status.OK, 5)
    assert result() == 5


def test_malformed_replies_are_dropped_and_counted(here: Container, callee: FakeCallee, asked: Any) -> None:
    call, result = asked
    callee.put(call, b"garbage")
    callee.put(call, b"")
    callee.answer(call, Status.OK, 666, v=FUTURE)
    callee.answer(call, 99, 666)
    callee.answer(call, Status.OK, 5)
    assert result() == 5
    assert here.dropped_messages == 4


def test_a_second_reply_changes_nothing(callee: FakeCallee, asked: Any) -> None:
    call, result = asked
    callee.answer(call, Status.OK, 5)
    callee.answer(call, Status.OK, 6)
    assert result() == 5
    again = callee.handle.start()
    callee.answer(callee.next(), Status.OK, 7)
    assert again.result(20) == 7


def test_a_result_of_another_type_than_described_is_an_invalid_result(callee: FakeCallee, asked: Any) -> None:
    call, result = asked
    callee.answer(call, Status.OK, "text")
    with pytest.raises(InvalidResult, match=r"forged.go ran, but .* Expected `int`, got `str`"):
        result()


@pytest.mark.parametrize("body", [None, 5, {"type": 5}, []], ids=str)
def test_an_error_that_cannot_be_read_is_still_an_error(callee: FakeCallee, asked: Any, body: Any) -> None:
    call, result = asked
    callee.answer(call, Status.ERROR, body)
    with pytest.raises(RemoteError, match=r"forged.go raised an error that cannot be read"):
        result()


def test_an_error_whose_text_is_none_is_still_an_error(callee: FakeCallee, asked: Any) -> None:
    call, result = asked
    callee.answer(call, Status.ERROR, msgspec.Raw(b"\x83\xa4type\xa1a\xa7message\xa1\xff\xa6fields\x80"))
    with pytest.raises(RemoteError, match=r"forged.go raised an error that cannot be read"):
        result()


NOT_LOADED: Final = "turtledemo.clock"
PATHS: Final = [
    "os:system",
    "subprocess:Popen",
    "builtins:exec",
    "builtins:SystemExit",
    f"{NOT_LOADED}:Turtle",
    "trade:where",
]


@pytest.mark.parametrize("path", PATHS)
def test_a_class_path_in_an_error_loads_nothing_and_calls_nothing(callee: FakeCallee, asked: Any, path: str) -> None:
    call, result = asked
    fields = {"args": [["touch", "/nowhere"]], "__class__": "x"}
    callee.answer(call, Status.ERROR, {"type": path, "message": "touch /nowhere", "fields": fields})
    with pytest.raises(RemoteError) as raised:
        result()
    assert raised.value.type_name == path
    assert NOT_LOADED not in sys.modules


@pytest.mark.parametrize("path", PATHS)
def test_a_class_path_in_a_description_loads_nothing_and_calls_nothing(path: str) -> None:
    definition = {"type": "object", "properties": {"args": {"type": "array"}}, "required": ["args"]}
    message = schema_message({"$ref": "#/$defs/Evil"}, {"Evil": definition})
    info = ServiceInfo(name="go", signature="go()", result_schema=message, types={"Evil": path})
    codec = handle_codec(lambda handle: handle.key, lambda key: None)  # type: ignore[arg-type,return-value]
    decoded = result_decoder(codec, info)(msgspec.msgpack.encode({"args": ["touch", "/nowhere"]}))
    assert decoded.args == ["touch", "/nowhere"]
    assert type(decoded).__module__ not in {"os", "subprocess", "builtins"}
    assert NOT_LOADED not in sys.modules
