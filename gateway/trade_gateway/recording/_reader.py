"""Reads a recording, up to its end or to where its writer was killed."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from zstandard import ZstdError

from trade.errors import ConfigurationError

_BROKEN: Final = (McapError, struct.error, ValueError, ZstdError)
"""What the library raises at an incomplete end of a file."""


class RecordedMessage(NamedTuple):
    """One message of a recording."""

    topic: str
    arrived_ns: int
    stamp_ns: int
    data: bytes


def entries(path: Path) -> Iterator[RecordedMessage]:
    """Yields the messages of a recording in their written order, up to an incomplete end.

    Raises:
        ConfigurationError: the file does not exist, or is not an MCAP file.
    """
    topics: dict[int, str] = {}
    try:
        with path.open("rb") as file:
            reader = StreamReader(file, validate_crcs=True)
            for record in _whole(reader, path):
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    yield RecordedMessage(topics[record.channel_id], record.log_time, record.publish_time, record.data)
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad.strerror}") from None


def _whole(reader: StreamReader, path: Path) -> Iterator[object]:
    begun = False
    try:
        for record in reader.records:
            begun = True
            yield record
    except EndOfFile:
        return
    except _BROKEN as bad:
        if not begun:
            raise ConfigurationError(where=str(path), problem=f"is not a recording: {bad}") from None
