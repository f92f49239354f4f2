"""The listener's side of streams: what somebody hears of one service, kept until it is taken."""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import msgspec

from trade._calls.handle import Handle
from trade._context.sessions import Session
from trade._protocol.messages import UNREADABLE, ErrorInfo
from trade._protocol.remote_errors import unpack_error
from trade._protocol.samples import Sample, StreamSample
from trade._threads.condition import InterruptibleCondition
from trade.errors import ConfigurationError, InvalidResult, SessionEnded

__all__ = ["Stream"]

_decode_error: Final = msgspec.msgpack.Decoder(ErrorInfo).decode

If = Callable[[Any], object]


class _Heard(NamedTuple):
    """A sample that waits to be taken."""

    sample: Sample
    missed: int
    """How many were missed on the way since the stream began."""


class Stream:
    """Samples of one service, as they come: iterate over it, in a thread or with ``async for``, or ask for `latest`.

    Made by `Container.stream`; a context manager, also of asyncio. Who takes them too slowly has the newest, and each
    sample says how many are missing before it. While its source cannot be reached nothing comes; when the same
    container is back, so are its samples.
    """

    def __init__(
        self,
        name: str,
        source: Handle,
        hz: float,
        decode: Callable[[Any], Any],
        *,
        on_change: bool,
        if_: If | None,
        keep: int,
        opened_by: Session | None,
        ended: Callable[["Stream"], None],
    ) -> None:
        self.name: Final = name
        """Names it among the listeners of its container."""
        self.source: Final = source
        """The service."""
        self.hz = hz
        """How many samples a second at most: what was asked for, or fewer if a gateway lets no more pass."""
        self.on_change: Final = on_change
        self.opened_by: Final = opened_by
        """The session that it ends with; none: its container."""
        self._decode = decode
        self._if = if_
        self._tell_ended = ended
        self._lock = threading.Lock()
        self._waiting: deque[_Heard | BaseException] = deque()
        self._keep = keep
        self._body: tuple[bool, bytes] | None = None
        """What was heard last, of those that are its own."""
        self._number = self._missed = self._told = self._overflowed = 0
        self._latest: Sample | BaseException | None = None
        self._end: BaseException | None = None
        self._closed = False
        self._changed = InterruptibleCondition()
        self._told_of_more: set[Callable[[], None]] = set()

    # --- taking

    def next(self, timeout_s: float | None = None) -> Sample:
        """The oldest sample that was not taken yet; waits for one.

        Args:
            timeout_s: give up after so many seconds; by default one waits as long as the stream stands.

        Raises:
            TimeoutError: none came in time.
            ServiceGone: the service was deregistered.
            SourceLost: its container cannot be reached; said once, and samples come again when it is back.
            AccessDenied: the policy no longer lets this container read the service.
            SessionEnded: the session that opened it was closed.
            ConfigurationError: the stream was closed.
            Exception: what the service itself raises, for each sample at which it does.
        """
        taken: list[Sample] = []

        def came() -> bool:
            sample = self.take()
            taken.extend([] if sample is None else [sample])
            return bool(taken)

        if not self._changed.wait_for(came, timeout_s):
            raise TimeoutError(f"no sample of {self.source.label} came within {timeout_s} s")
        return taken[0]

    async def anext(self) -> Sample:
        """`next` from asyncio, without a time limit of its own."""
        loop, woken = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # that loop has ended
                loop.call_soon_threadsafe(woken.set)

        self.tell(wake)
        try:
            while (taken := self.take()) is None:
                await woken.wait()
                woken.clear()
        finally:
            self._told_of_more.discard(wake)
        return taken

    def tell(self, more: Callable[[], None]) -> None:
        """Have this called whenever there is more to take, or nothing more will come; it must not wait."""
        self._told_of_more.add(more)

    def take(self) -> Sample | None:
        """The oldest sample that was not taken yet, None if there is none now. Raises like `next`."""
        with self._lock:
            if not self._waiting:
                if self._end is not None:
                    raise self._end
                return None
            heard = self._waiting.popleft()
            if isinstance(heard, BaseException):
                raise heard
            dropped = heard.missed - self._told + self._overflowed
            self._told, self._overflowed = heard.missed, 0
        return msgspec.structs.replace(heard.sample, dropped=dropped) if dropped else heard.sample

    def latest(self) -> Sample | None:
        """The newest sample, None before the first; takes nothing and waits for nothing.

        Raises:
            Exception: like `next`, if what was heard last is no sample; for as long as that is so.
        """
        latest = self._end or self._latest
        if isinstance(latest, BaseException):
            raise latest
        return latest

    def __iter__(self) -> "Stream":
        return self

    def __next__(self) -> Sample:
        if self._closed:
            raise StopIteration
        return self.next()

    def __aiter__(self) -> "Stream":
        return self

    async def __anext__(self) -> Sample:
        if self._closed:
            raise StopAsyncIteration
        return await self.anext()

    # --- ends

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        return self._end is not None

    @property
    def why_ended(self) -> BaseException | None:
        """What `next` raises once all was taken, if it has ended."""
        return self._end

    def close(self) -> None:
        """Listen no more; what was not taken is gone. Idempotent."""
        self._closed = True
        with self._lock:
            self._waiting.clear()
        self.end(ConfigurationError(where=self.source.label, problem="this stream was closed; open another one"))

    def end(self, why: BaseException) -> None:
        """Told by the container: nothing more will come. What has come can still be taken."""
        with self._lock:
            if self._end is not None:
                return
            self._end = why
        self._ring()
        self._tell_ended(self)

    def session_ended(self, session: str) -> None:
        """Told by the container."""
        if self.opened_by is not None and self.opened_by.name == session:
            self.end(SessionEnded(session=session, reason="it was closed"))

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    async def __aenter__(self) -> "Stream":
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.shield(asyncio.ensure_future(asyncio.to_thread(self.close)))

    def __repr__(self) -> str:
        return f"<Stream of {self.source.label}, {self.hz:g} Hz{', ended' if self.ended else ''}>"

    # --- hearing

    def hear(self, message: StreamSample) -> None:
        """Told by the container: the source has put this."""
        if self._number:  # a lower number: the source counts anew
            self._missed += max(0, message.number - self._number - 1)
        self._number = message.number
        body = (message.failed, bytes(message.body))
        if self.on_change and body == self._body:
            return
        self._body = body
        try:
            heard = self._read(message)
        except Exception as bad:  # noqa: BLE001 - of the condition, which is the listener's own
            heard = bad
        if heard is not None:
            self.add(heard)
        elif isinstance(self._latest, BaseException):  # it is over
            self._latest = None

    def _read(self, message: StreamSample) -> Sample | BaseException | None:
        """A sample or an error; None if it does not meet the condition."""
        label = self.source.label
        try:
            if message.failed:
                return unpack_error(_decode_error(message.body), label)
            value = self._decode(message.body)
        except UNREADABLE as bad:
            return InvalidResult(service=label, problem=str(bad))
        if self._if is not None and not self._if(value):
            return None
        return Sample(value=value, at=message.at, at_ns=message.at_ns, number=message.number)

    def at_rate(self, hz: float) -> None:
        """Told by the container: what comes now are samples of that rate, which are counted for themselves."""
        self.hz, self._number = hz, 0

    def lost(self, error: BaseException) -> None:
        """Told by the container: the source is out of reach. What it says when it is back is news, changed or not."""
        self._body = None
        self.add(error)

    def add(self, heard: Sample | BaseException) -> None:
        """Keep it until it is taken; the oldest goes if there are too many."""
        with self._lock:
            if self._end is not None:
                return
            self._latest = heard
            if len(self._waiting) >= self._keep and isinstance(self._waiting.popleft(), _Heard):
                self._overflowed += 1
            self._waiting.append(heard if isinstance(heard, BaseException) else _Heard(heard, self._missed))
        self._ring()

    def _ring(self) -> None:
        self._changed.notify_all()
        for tell in list(self._told_of_more):
            tell()
