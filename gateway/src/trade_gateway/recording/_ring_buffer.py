"""The last seconds of everything, in memory: bounded in time and in bytes."""

from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from trade_gateway.recording._channels import Message
from trade_gateway.recording._file import Attachment, RecordingFile

__all__ = ["Ring"]


class Ring:
    """Messages of the last seconds. Used by one thread."""

    def __init__(self, keep_s: float, most_bytes: int) -> None:
        self._keep_ns = int(keep_s * 1e9)
        self._most_bytes = most_bytes
        self._kept: deque[Message] = deque()
        self.size_bytes = 0
        """Of what is kept."""
        self.cut_short = 0
        """So many messages had to go before their time, for want of room."""

    def write(self, message: Message) -> None:
        """Keep it, and let go of what is too old or too much."""
        self._kept.append(message)
        self.size_bytes += len(message.data)
        while self._kept[0].arrived_ns < message.arrived_ns - self._keep_ns:
            self._drop()
        while self.size_bytes > self._most_bytes and len(self._kept) > 1:
            self._drop()
            self.cut_short += 1

    def _drop(self) -> None:
        self.size_bytes -= len(self._kept.popleft().data)

    def save(self, path: Path, about: Mapping[str, str], attachments: Sequence[Attachment] = ()) -> int:
        """Write what is kept to a file, and keep it; returns how many messages there are. Raises like the file."""
        with RecordingFile(path, about, attachments) as file:
            for message in self._kept:
                file.write(message)
        return len(self._kept)
