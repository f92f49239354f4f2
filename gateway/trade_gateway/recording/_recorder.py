"""Records a system: moves messages from the sources and the poller to a file or a ring buffer."""

import platform
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Final, Protocol

from trade import Container
from trade_gateway.process._signals import SignalEvent
from trade_gateway.recording._channels import Message
from trade_gateway.recording._file import Attachment, RecordingFile
from trade_gateway.recording._poller import Watch
from trade_gateway.recording._sources import RecordedParts, Sources
from trade_gateway.recording._timeline import Timeline


class Ring:
    """A ring buffer of the last seconds' messages. Used by one thread."""

    def __init__(self, keep_s: float, most_bytes: int) -> None:
        self._keep_ns = int(keep_s * 1e9)
        self._most_bytes = most_bytes
        self._messages: deque[Message] = deque()
        self.size_bytes = 0
        """Size of the kept messages in bytes."""
        self.cut_short = 0
        """Number of messages that were dropped early for lack of space."""

    def write(self, message: Message) -> None:
        """Adds a message, and drops what is too old or too much."""
        self._messages.append(message)
        self.size_bytes += len(message.data)
        while self._messages[0].arrived_ns < message.arrived_ns - self._keep_ns:
            self._drop()
        while self.size_bytes > self._most_bytes and len(self._messages) > 1:
            self._drop()
            self.cut_short += 1

    def _drop(self) -> None:
        self.size_bytes -= len(self._messages.popleft().data)

    def save(self, path: Path, about: Mapping[str, str], attachments: Sequence[Attachment] = ()) -> int:
        """Writes the kept messages to a file, and keeps them; returns their number. Raises like the file."""
        with RecordingFile(path, about, attachments) as file:
            for message in self._messages:
                file.write(message)
        return len(self._messages)


_LOOK_S: Final = 0.5
"""Period of the search for new and lost services, in seconds."""
_BEAT_S: Final = 1.0


class Sink(Protocol):
    """A destination of messages."""

    def write(self, message: Message) -> None: ...


class Recorder:
    """Records a system until its end is requested. Used by one thread; a context manager."""

    def __init__(self, container: Container, wanted: RecordedParts, ending: threading.Event | SignalEvent) -> None:
        """Starts the subscriptions.

        Args:
            container: the recorder's own container.
            wanted: the parts of the system to record.
            ending: ends ``run`` within half a second after it is set.
        """
        self.container: Final = container
        self._wake = threading.Event()
        self._ending = ending
        self._timeline = Timeline()
        self._sources = Sources(container, wanted, self._wake, self._timeline)
        self._watch = Watch(container, list(wanted.groups), self._wake, self._timeline)
        self.messages = 0

    @property
    def dropped(self) -> int:
        """Number of samples lost on the way, or because of a slow disk."""
        return self._sources.dropped

    @property
    def refused(self) -> str:
        """Why calls or locks are not recorded; empty: they are."""
        return self._watch.refused

    def listening_to(self) -> list[str]:
        """Labels of the sampled services."""
        return self._sources.labels()

    def look(self) -> list[str]:
        """Subscribes to the services present now; returns their labels."""
        self._sources.look()
        return self.listening_to()

    def run(self, sink: Sink, seconds: float | None, beat: Callable[[], None]) -> None:
        """Records until the end is requested.

        Args:
            sink: the destination; its exceptions are raised.
            seconds: the longest duration; None for no limit.
            beat: called every second, and once at the end.
        """
        began = looked = beaten = time.monotonic()
        while not self._ending.is_set():
            now = time.monotonic()
            if seconds is not None and now - began >= seconds:
                break
            if now - looked >= _LOOK_S:
                self._sources.look()
                looked = now
            self._pass_on(sink)
            if now - beaten >= _BEAT_S:
                beat()
                beaten = now
            left = _LOOK_S if seconds is None else min(_LOOK_S, max(0.0, began + seconds - now))
            self._wake.wait(left)
            self._wake.clear()
        self._watch.close()
        self._pass_on(sink)
        beat()

    def _pass_on(self, sink: Sink) -> None:
        for message in self._new():
            sink.write(message)
            self.messages += 1

    def _new(self) -> Iterator[Message]:
        for message in chain(self._sources.take(), self._watch.take()):
            yield message._replace(arrived_ns=self._timeline.now_ns())

    def close(self) -> None:
        """Ends all subscriptions. Idempotent."""
        self._watch.close()
        self._sources.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def about(container: Container, wanted: RecordedParts) -> dict[str, str]:
    """The metadata of a recording."""
    return {
        "system": container.settings.system,
        "groups": ",".join(wanted.groups),
        "began_s": f"{time.time():.3f}",
        "trade": version("trade-core"),
        "python": platform.python_version(),
        "host": platform.node(),
    }
