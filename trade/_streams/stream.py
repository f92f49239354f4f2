"""The listener's side of streams: the samples of one service, kept until they are taken."""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Final, Generic, NamedTuple

import msgspec

from trade._calls.handle import Handle
from trade._context.sessions import Session
from trade._threads.condition import InterruptibleCondition
from trade.errors import ConfigurationError, InvalidResult, SessionEnded
from trade.protocol.messages import UNREADABLE, ErrorInfo
from trade.protocol.remote_errors import unpack_error
from trade.protocol.samples import Sample, StreamSample, Value

_decode_error: Final = msgspec.msgpack.Decoder(ErrorInfo).decode

If = Callable[[Any], object]


class _PendingSample(NamedTuple):
    """A sample that has not been taken yet."""

    sample: Sample
    missed: int
    """How many were lost in transit since the stream began."""


class Stream(Generic[Value]):
    """Samples of one service: iterate over it, in a thread or with ``async for``, or read `latest`.

    Made by `Container.stream`; a context manager, also of asyncio. A slow reader gets the newest samples, and each
    sample says how many are missing before it. No samples come while the source is unreachable; when the same container
    is back, the stream continues.
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
        """Identifies it among the streams of its container."""
        self.source: Final = source
        """The service."""
        self.hz = hz
        """The largest number of samples a second: as requested, or fewer if a gateway limits the rate."""
        self.on_change: Final = on_change
        self.opened_by: Final = opened_by
        """The session that it ends with; None: its container."""
        self._decode = decode
        self._if = if_
        self._on_ended = ended
        self._lock = threading.Lock()
        self._waiting: deque[_PendingSample | BaseException] = deque()
        self._keep = keep
        self._body: tuple[bool, bytes] | None = None
        """The last message received that is its own."""
        self._number = self._missed = self._reported = self._overflowed = 0
        self._latest: Sample | BaseException | None = None
        self._end: BaseException | None = None
        self._closed = False
        self._changed = InterruptibleCondition()
        self._callbacks: set[Callable[[], None]] = set()

    # --- taking

    def next(self, timeout_s: float | None = None) -> Sample[Value]:
        """The oldest sample not taken yet; waits for one.

        Args:
            timeout_s: how long to wait, in seconds; by default as long as the stream is open.

        Raises:
            TimeoutError: no sample came in time.
            ServiceGone: the service was deregistered.
            SourceLost: its container is unreachable; raised once, and samples continue when it is back.
            AccessDenied: the policy no longer lets this container read the service.
            SessionEnded: the session that opened it was closed.
            ConfigurationError: the stream was closed.
            Exception: the error of the service itself, for each sample that failed.
        """
        taken: list[Sample[Value]] = []

        def received() -> bool:
            sample = self.take()
            taken.extend([] if sample is None else [sample])
            return bool(taken)

        if not self._changed.wait_for(received, timeout_s):
            raise TimeoutError(f"no sample of {self.source.label} came within {timeout_s} s")
        return taken[0]

    async def anext(self) -> Sample[Value]:
        """`next` for asyncio, without a time limit of its own."""
        loop, woken = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(woken.set)

        self.on_sample(wake)
        try:
            while (taken := self.take()) is None:
                await woken.wait()
                woken.clear()
        finally:
            self._callbacks.discard(wake)
        return taken

    def on_sample(self, callback: Callable[[], None]) -> None:
        """Have a function called whenever there is more to take, or the stream ends; it must not block."""
        self._callbacks.add(callback)

    def take(self) -> Sample[Value] | None:
        """The oldest sample not taken yet, None if there is none now. Raises like `next`."""
        with self._lock:
            if not self._waiting:
                if self._end is not None:
                    raise self._end
                return None
            pending = self._waiting.popleft()
            if isinstance(pending, BaseException):
                raise pending
            dropped = pending.missed - self._reported + self._overflowed
            self._reported, self._overflowed = pending.missed, 0
        return msgspec.structs.replace(pending.sample, dropped=dropped) if dropped else pending.sample

    def latest(self) -> Sample[Value] | None:
        """The newest sample, None before the first; neither takes nor waits.

        Raises:
            Exception: like `next`, for as long as the last message is not a sample.
        """
        latest = self._end or self._latest
        if isinstance(latest, BaseException):
            raise latest
        return latest

    def __iter__(self) -> "Stream[Value]":
        return self

    def __next__(self) -> Sample[Value]:
        if self._closed:
            raise StopIteration
        return self.next()

    def __aiter__(self) -> "Stream[Value]":
        return self

    async def __anext__(self) -> Sample[Value]:
        if self._closed:
            raise StopAsyncIteration
        return await self.anext()

    # --- ends

    @property
    def ended(self) -> bool:
        """Whether no more samples will come."""
        return self._end is not None

    @property
    def why_ended(self) -> BaseException | None:
        """The error that `next` raises once all samples were taken, if the stream has ended."""
        return self._end

    def close(self) -> None:
        """Stop listening and discard samples not taken. Idempotent."""
        self._closed = True
        with self._lock:
            self._waiting.clear()
        self.end(ConfigurationError(where=self.source.label, problem="this stream was closed; open another one"))

    def end(self, error: BaseException) -> None:
        """Called by the container: no more samples come. Those already here can still be taken."""
        with self._lock:
            if self._end is not None:
                return
            self._end = error
        self._ring()
        self._on_ended(self)

    def session_ended(self, session: str) -> None:
        """Called by the container."""
        if self.opened_by is not None and self.opened_by.name == session:
            self.end(SessionEnded(session=session, reason="it was closed"))

    def __enter__(self) -> "Stream[Value]":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    async def __aenter__(self) -> "Stream[Value]":
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.shield(asyncio.ensure_future(asyncio.to_thread(self.close)))

    def __repr__(self) -> str:
        return f"<Stream of {self.source.label}, {self.hz:g} Hz{', ended' if self.ended else ''}>"

    # --- hearing

    def hear(self, message: StreamSample) -> None:
        """Called by the container: a message of the source."""
        if self._number:  # a lower number: the source started to count again
            self._missed += max(0, message.number - self._number - 1)
        self._number = message.number
        body = (message.failed, bytes(message.body))
        if self.on_change and body == self._body:
            return
        self._body = body
        try:
            heard = self._read(message)
        except Exception as bad:  # noqa: BLE001 - from the condition, which is the listener's own
            heard = bad
        if heard is not None:
            self.add(heard)
        elif isinstance(self._latest, BaseException):  # the error is over
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
        """Called by the container: later samples have that rate, and their own count."""
        self.hz, self._number = hz, 0

    def lost(self, error: BaseException) -> None:
        """Called by the container: the source is unreachable. Its next sample is reported, changed or not."""
        self._body = None
        self.add(error)

    def add(self, heard: Sample | BaseException) -> None:
        """Keep a sample until it is taken; drop the oldest if there are too many."""
        with self._lock:
            if self._end is not None:
                return
            self._latest = heard
            if len(self._waiting) >= self._keep and isinstance(self._waiting.popleft(), _PendingSample):
                self._overflowed += 1
            self._waiting.append(heard if isinstance(heard, BaseException) else _PendingSample(heard, self._missed))
        self._ring()

    def _ring(self) -> None:
        self._changed.notify_all()
        for tell in list(self._callbacks):
            tell()
