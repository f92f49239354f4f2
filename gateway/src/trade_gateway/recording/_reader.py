"""Reading a recording, also one whose writer was killed: as far as it goes."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from zstandard import ZstdError

from trade.errors import ConfigurationError

__all__ = ["Entry", "entries"]

_BROKEN: Final = (McapError, struct.error, ValueError, ZstdError)
"""What the library raises where a file ends in the middle of something."""


class Entry(NamedTuple):
    """One message of a recording."""

    topic: str
    arrived_ns: int
    stamp_ns: int
    data: bytes


def entries(path: Path) -> Iterator[Entry]:
    """The messages of a recording in the order they were written; they end where the file is not whole.

    Raises:
        ConfigurationError: there is no such file, or it is no MCAP file at all.
    """
    topics: dict[int, str] = {}
    try:
        with path.open("rb") as file:
            reader = StreamReader(file, validate_crcs=True)
            for record in _whole(reader, path):
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    yield Entry(topics[record.channel_id], record.log_time, record.publish_time, record.data)
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
            raise ConfigurationError(where=str(path), problem=f"is no recording: {bad}") from None
