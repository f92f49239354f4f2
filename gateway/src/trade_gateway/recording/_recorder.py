"""One recording under way: takes what sources and watch have, and gives it to a file or to the ring."""

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
from trade_gateway.recording._sources import Sources, Wanted

__all__ = ["Recorder", "Ring", "Sink", "about"]


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


_LOOK_S: Final = 0.5
"""So often it looks for services that have come or gone."""
_BEAT_S: Final = 1.0


class Sink(Protocol):
    """Where messages go."""

    def write(self, message: Message) -> None: ...


class Recorder:
    """Reads a system until it is told to end. Used by one thread; a context manager."""

    def __init__(self, container: Container, wanted: Wanted, ending: threading.Event | SignalEvent) -> None:
        """Begin to watch.

        Args:
            container: of its own.
            wanted: what of the system.
            ending: ends ``run`` within half a second of being set.
        """
        self._wake = threading.Event()
        self._ending = ending
        self._sources = Sources(container, wanted, self._wake)
        self._watch = Watch(container, list(wanted.groups), self._wake)
        self.messages = 0
        self._ahead_ns = 0
        """The clock on the wall ahead of the one that always runs, at most so far."""

    @property
    def dropped(self) -> int:
        """Samples that were lost on the way, or while the disk was too slow."""
        return self._sources.dropped

    @property
    def refused(self) -> str:
        """Why calls or locks are not recorded; empty: they are."""
        return self._watch.refused

    def listening_to(self) -> list[str]:
        """The services that are sampled."""
        return self._sources.labels()

    def look(self) -> list[str]:
        """Listen to what there is now; the services."""
        self._sources.look()
        return self.listening_to()

    def run(self, sink: Sink, seconds: float | None, beat: Callable[[], None]) -> None:
        """Record until it is asked to end.

        Args:
            sink: where to; what it raises passes.
            seconds: or so long.
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
            yield message._replace(arrived_ns=self._now_ns())

    def _now_ns(self) -> int:
        """Since the epoch; it follows the clock on the wall forwards, and goes on evenly where that is put back."""
        running_ns = time.monotonic_ns()
        self._ahead_ns = max(self._ahead_ns, time.time_ns() - running_ns)
        return running_ns + self._ahead_ns

    def close(self) -> None:
        """Listen to nothing more. Idempotent."""
        self._watch.close()
        self._sources.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def about(container: Container, wanted: Wanted) -> dict[str, str]:
    """What a recording says of itself."""
    return {
        "system": container.settings.system,
        "groups": ",".join(wanted.groups),
        "began_s": f"{time.time():.3f}",
        "trade": version("trade-core"),
        "python": platform.python_version(),
        "host": platform.node(),
    }
