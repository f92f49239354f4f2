"""A writer of MCAP files that stay readable up to the last second after a crash, and are closed on a full disk."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import IO, Any, Final, Protocol, cast

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from trade.errors import ConfigurationError
from trade_gateway.recording._channels import Channel, Message

_CHUNK_BYTES: Final = 1 << 20
_SEQUENCE: Final = (1 << 32) - 1

Attachment = tuple[str, bytes]
"""Name and content of a file that is stored in the recording."""


class Raw(Protocol):
    """An unbuffered file; ``write`` may accept only a part."""

    def write(self, data: Any, /) -> int | None: ...
    def tell(self) -> int: ...
    def seek(self, offset: int, /) -> int: ...
    def truncate(self, size: int, /) -> int: ...
    def close(self) -> None: ...


def _unbuffered(path: Path) -> Raw:
    return path.open("xb", buffering=0)


class RecordingFile:
    """One recording. Used by one thread; a context manager.

    When a write fails, the file is ended after its last complete chunk, without an index, and OSError is raised.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        attachments: Sequence[Attachment] = (),
        opened: Callable[[Path], Raw] = _unbuffered,
    ) -> None:
        """Creates the file.

        Args:
            path: an existing file is not overwritten.
            about: content of the metadata record ``trade``.
            attachments: robot files and others.
            opened: opens the file.

        Raises:
            ConfigurationError: it cannot be created.
        """
        try:
            self._raw: Final = opened(path)
        except OSError as bad:
            raise ConfigurationError(where=str(path), problem=f"cannot be written: {bad.strerror}") from None
        self.path: Final = path
        self.messages = 0
        self.size_bytes = 0
        """The size of the file up to its last complete chunk."""
        self._channels: dict[tuple[str, str], int] = {}
        self._closed = False
        stream = cast("IO[Any]", _Whole(self._raw))
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._do(lambda: self._begin(about, attachments))

    def _begin(self, about: Mapping[str, str], attachments: Sequence[Attachment]) -> None:
        now_ns = max(0, time.time_ns())  # the format has no time before 1970
        self._writer.start()
        for name, data in attachments:
            self._writer.add_attachment(now_ns, now_ns, name, "application/toml", data)
        self._writer.add_metadata("trade", dict(about))

    def write(self, message: Message) -> None:
        """Adds a message; it is in the file after the next ``flush``, or earlier."""
        self._do(lambda: self._add(message))

    def _add(self, message: Message) -> None:
        channel = self._channel(message.channel)
        self.messages += 1
        number = self.messages & _SEQUENCE
        self._writer.add_message(channel, message.arrived_ns, message.data, message.stamp_ns, sequence=number)

    def _channel(self, channel: Channel) -> int:
        key = channel.topic, channel.schema_name
        known = self._channels.get(key)
        if known is None:
            schema = self._writer.register_schema(channel.schema_name, "jsonschema", channel.schema)
            known = self._channels[key] = self._writer.register_channel(channel.topic, "json", schema)
        return known

    def flush(self) -> None:
        """Writes all messages to the file: they are readable from now on, even if this process is killed."""
        self._do(self._writer.flush)

    def close(self) -> None:
        """Ends the file with its index. Idempotent."""
        if not self._closed:
            self._do(self._writer.finish)
            self._closed = True
            self._raw.close()

    def _do(self, write: Callable[[], object]) -> None:
        try:
            write()
        except OSError:
            self._cut_off()
            raise
        self.size_bytes = self._raw.tell()

    def _cut_off(self) -> None:
        """Ends the file after its last complete chunk; the freed space is enough for that."""
        self._closed = True
        end = RecordBuilder()
        DataEnd(0).write(end)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(end)
        with closing(self._raw):
            self._raw.truncate(self.size_bytes)
            self._raw.seek(self.size_bytes)
            _Whole(self._raw).write(end.end() + MCAP0_MAGIC)

    def __enter__(self) -> "RecordingFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Whole:
    """A file that writes everything or raises."""

    def __init__(self, raw: Raw) -> None:
        self._raw = raw
        self.tell = raw.tell

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        while left:
            left = left[self._raw.write(left) or 0 :]
        return len(data)

    def flush(self) -> None:
        """Does nothing, as nothing is buffered."""
