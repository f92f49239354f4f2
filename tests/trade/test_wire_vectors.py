"""The bytes that other languages test themselves with are those that this one speaks."""

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from trade import _estop_messages, _wire
from trade._sample import decode_sample
from vectors import DROPPED, FILE, MESSAGES, kind_of, text

READERS: dict[str, Callable[[bytes], Any]] = {
    "Call": _wire.decode_call,
    "Reply": _wire.decode_reply,
    "Tally": _wire.decode_tally,
    "ProviderInfo": _wire.decode_provider,
    "EstopOrder": lambda data: _estop_messages.decode_estop_order(data, "anna"),
    "EstopConfirmed": _estop_messages.decode_estop_confirmed,
    "StreamSample": decode_sample,
}


def test_the_file_is_what_the_codec_says() -> None:
    """If the protocol is meant to change: python tests/vectors.py, and docs/wire-protocol.md with it."""
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
    with pytest.raises(_wire.Malformed):
        READERS[kind](data)
