"""One recording under way: takes what sources and watch have, and gives it to a file or to the ring."""

import platform
import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from itertools import chain
from typing import Final, Protocol

from trade import Container
from trade_gateway.process._signal_event import SignalEvent
from trade_gateway.recording._channels import Message
from trade_gateway.recording._poller import Watch
from trade_gateway.recording._sources import Sources, Wanted

__all__ = ["Recorder", "Sink", "about"]

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
