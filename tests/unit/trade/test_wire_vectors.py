"""The bytes that other languages test themselves with are those that this one speaks."""

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from tests.unit.trade.wire_vectors import DROPPED, FILE, MESSAGES, kind_of, text
from trade.protocol import estop_messages, messages
from trade.protocol.samples import decode_sample

READERS: dict[str, Callable[[bytes], Any]] = {
    "Call": messages.decode_call,
    "Reply": messages.decode_reply,
    "Tally": messages.decode_tally,
    "ProviderInfo": messages.decode_provider,
    "EstopOrder": lambda data: estop_messages.decode_estop_order(data, "anna"),
    "EstopConfirmed": estop_messages.decode_estop_confirmed,
    "StreamSample": decode_sample,
}


def test_the_file_is_what_the_codec_says() -> None:
    """After a change of the protocol: `python -m tests.unit.trade.wire_vectors`, and docs/wire-protocol.md."""
    assert FILE.read_text(encoding="utf-8") == text()


def test_there_is_a_message_of_every_kind() -> None:
    assert {kind_of(message) for message in MESSAGES.values()} >= set(READERS)


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_is_read_and_written_as_it_was(name: str) -> None:
    data = msgspec.msgpack.encode(MESSAGES[name])
    reader = READERS.get(kind_of(MESSAGES[name]))
    if reader is not None:
        assert msgspec.msgpack.encode(reader(data)) == data


@pytest.mark.parametrize("name", DROPPED)
def test_what_is_no_message_is_dropped(name: str) -> None:
    kind, data = DROPPED[name]
    with pytest.raises(messages.Malformed):
        READERS[kind](data)
