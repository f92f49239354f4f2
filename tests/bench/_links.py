"""What a peer is: a server, and a link whose caller makes one call at a time or keeps several under way."""

import itertools
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from typing import Any

Call = Callable[[bytes], bytes]


class Link(ABC):
    """A connection of a caller."""

    @abstractmethod
    def call(self, payload: bytes) -> bytes:
        """Send, and wait for the echo."""

    @abstractmethod
    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        """n calls, so many of them under way at a time, in the way that fits the peer best."""


class Peer(ABC):
    """One way to call another process."""

    name: str
    needs = ""
    """The module without which it cannot run."""
    most_bytes = 1 << 30
    """Larger calls of it are left out, because they would take minutes."""
    least_bytes = 0
    """Smaller calls of it are left out, because others show more."""
    python = ""
    """Another Python that both ends run under."""
    server_at = caller_at = ""
    """The network namespaces that its ends run in; by default the bench's own."""

    @property
    def missing(self) -> str:
        """Why it cannot run here; empty where it can."""
        if self.needs and find_spec(self.needs) is None:
            return f"the module {self.needs} is not installed"
        return ""

    @abstractmethod
    def serve(self) -> AbstractContextManager[str]:
        """Answer calls; gives what ``connect`` needs to find us."""

    @abstractmethod
    def connect(self, address: str) -> AbstractContextManager[Link]:
        """Be ready to call."""


class Pipeline(Link):
    """A link whose calls can begin before others have ended."""

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        waiting: deque[Any] = deque()
        for _ in range(n):
            if len(waiting) == in_flight:
                check(payload, self.end(waiting.popleft()))
            waiting.append(self.begin(payload))
        while waiting:
            check(payload, self.end(waiting.popleft()))

    def call(self, payload: bytes) -> bytes:
        return self.end(self.begin(payload))

    @abstractmethod
    def begin(self, payload: bytes) -> Any: ...
    @abstractmethod
    def end(self, begun: Any) -> bytes: ...


class Threads(Link):
    """A link whose callers wait, each in a thread of its own."""

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        left = itertools.count(1).__next__
        wrong: list[BaseException] = []

        def work(call: Call) -> None:
            try:
                while left() <= n:
                    check(payload, call(payload))
            except Exception as bad:  # noqa: BLE001 - raised by the thread that waits for all
                wrong.append(bad)

        threads = [threading.Thread(target=work, args=(call,)) for call in self.several(in_flight)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if wrong:
            raise wrong[0]

    @abstractmethod
    def several(self, count: int) -> Sequence[Call]:
        """Calls of which each may be made by another thread."""


def check(payload: bytes, answer: bytes) -> None:
    if answer != payload:
        raise RuntimeError(f"a wrong answer of {len(answer)} bytes: {answer[:80]!r}")
