"""The calls that a container runs or has run: each call id runs once, can be cancelled, and reports its progress."""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import lru_cache
from heapq import heappop, heappush
from typing import Any, Final

from msgspec import Raw, Struct

from trade._context.sessions import within
from trade._threads.scheduler import Scheduler
from trade.errors import Cancelled, OutcomeUnknown
from trade.protocol.messages import Call, LargeBytes, Status, encode_message
from trade.protocol.remote_errors import pack_error

_logger = logging.getLogger("trade")

GRACE_NS: Final = 5_000_000_000
"""How long after its deadline a call's answer is kept."""
MOST_BYTES: Final = 64 << 20
MOST_CALLS: Final = 65_536
_FORGOTTEN_AT_ONCE: Final = 8
"""How many calls one call forgets: after a burst, none pays for all of them."""
_MOST_CALLERS: Final = 1024
_END_S: Final = 2.0

Answer = tuple[int, Raw | LargeBytes]
Key = tuple[str, int]
"""Who called, and the call's id."""

_rare = threading.Lock()
"""Guards what few calls have: an event and cancel callbacks."""


class ActiveCall:
    """One call, from its arrival on."""

    __slots__ = (
        *("_event", "_on_cancel", "also", "answer", "call", "caller"),
        *("cancelled", "queued_ns", "report", "unsent"),
    )

    def __init__(self, caller: str, call: Call | None, report: "Callable[[ActiveCall, Any], None] | None") -> None:
        self.caller = caller
        self.call = call
        self.report = report
        """Takes the provider's progress without waiting: `Dispatcher._report`, or the local target's."""
        self.unsent: Raw | None = None
        """The latest progress that is not sent yet."""
        self.cancelled = False
        self.answer: Answer | None = None
        self.also: list[Call] | None = None
        """Repetitions of the same call that arrived while it ran."""
        self.queued_ns = 0
        """When it entered the queue of a serial provider; 0 if it did not."""
        self._event: threading.Event | None = None
        self._on_cancel: list[Callable[[], object]] | None = None

    def cancel(self) -> None:
        """Asks the provider to end it. Idempotent."""
        with _rare:
            if self.cancelled:
                return
            self.cancelled = True
            callbacks, self._on_cancel = self._on_cancel, None
            if self._event is not None:
                self._event.set()
        for callback in callbacks or ():
            callback()

    def on_cancel(self, callback: Callable[[], object]) -> Callable[[], None]:
        """Calls this when the call is cancelled; at once if it was. Returns a function that unsubscribes."""
        with _rare:
            known = not self.cancelled
            if known:
                self._on_cancel = [*(self._on_cancel or ()), callback]
        if not known:
            callback()

        def forget() -> None:
            with _rare:
                self._on_cancel = [one for one in self._on_cancel or () if one is not callback]

        return forget

    def wait_cancelled(self, timeout_s: float | None) -> bool:
        with _rare:
            if self._event is None:
                self._event = threading.Event()
                if self.cancelled:
                    self._event.set()
            event = self._event
        return event.wait(timeout_s)


class KeptAnswer(Struct, gc=False):
    """What remains of an ended call. The garbage collector does not visit it, as there are tens of thousands."""

    answer: Answer
    service: str
    """The service's name."""


def end_calls(cancels: Sequence[Callable[[], object]]) -> None:
    """Asks calls to end, on another thread, so that their callbacks do not delay the caller."""
    if cancels:
        threading.Thread(target=_end, args=(cancels,), name="trade-cancel", daemon=True).start()


def _end(cancels: Sequence[Callable[[], object]]) -> None:
    for cancel in cancels:
        try:
            cancel()
        except Exception:
            _logger.exception("a call could not be cancelled")


class CallDeduplicator:
    """Runs no call twice: it keeps running calls, and answers of commands until the calls can no longer be repeated.

    A call that only reads is forgotten when it ends: repeating it changes nothing. A running call is never forgotten.
    If answers are too many or too large, the oldest lose their text first, and only their number stays known.
    """

    def __init__(self) -> None:
        self._running: dict[Key, ActiveCall] = {}
        self._kept: dict[Key, KeptAnswer] = {}
        self._until: list[tuple[int, Key]] = []
        """A heap of times from which kept calls may be forgotten."""
        self._bodies: OrderedDict[Key, KeptAnswer] = OrderedDict()
        """The oldest first, which is found at once however many came before it."""
        self._bytes = 0
        self._evicted: dict[Key, int] = {}
        """Caller and upper bits of its ids -> the highest id that was evicted early; ids count upwards."""
        self._lock = threading.Lock()

    def begin(self, call: Call, ongoing: ActiveCall) -> ActiveCall | KeptAnswer:
        """Records a call; returns the earlier one if it is a repetition, which must not run again."""
        key = ongoing.caller, call.id
        with self._lock:
            found = self._find(key)
            if found is not None:
                return found
            if self._evicted and call.id <= self._evicted.get((ongoing.caller, call.id >> 24), -1):
                ongoing.answer = _unknown(call.service)
            else:
                self._running[key] = ongoing
            return ongoing

    def find(self, caller: str, call: Call) -> ActiveCall | KeptAnswer | None:
        with self._lock:
            return self._find((caller, call.id))

    def _find(self, key: Key) -> ActiveCall | KeptAnswer | None:
        """Requires the lock."""
        return self._running.get(key) or self._kept.get(key)

    def attach(self, first: ActiveCall | KeptAnswer, again: Call) -> Answer | None:
        """The answer to a repeated call; None while it runs: the answer then goes to the repetition, too."""
        with self._lock:
            if isinstance(first, ActiveCall) and first.answer is None:
                first.also = [*(first.also or ()), again]
            return first.answer

    def end(self, ongoing: ActiveCall, call: Call, answer: Answer, *, keep: bool) -> list[Call] | None:
        """Records how it ended; returns the repetitions to answer."""
        with self._lock:
            ongoing.answer = answer
            ongoing.call = ongoing.report = None  # the arguments may be large
            key = ongoing.caller, call.id
            self._running.pop(key, None)
            if keep:
                now = time.monotonic_ns()
                kept = self._bodies[key] = KeptAnswer(answer, call.service)
                self._bytes += len(answer[1])
                self._drop_bodies()
                self._keep(key, kept, call.expires_ns or now, now)
            return ongoing.also

    def cancel(self, caller: str, call_id: int, service: str, keep_s: float) -> None:
        """Cancels a call of this caller: asks it to end, or prevents it from starting if it has not arrived yet."""
        with self._lock:
            found = self._find((caller, call_id))
            if found is None:
                now = time.monotonic_ns()
                self._keep((caller, call_id), KeptAnswer(cancelled(service), service), now + int(keep_s * 1e9), now)
        if isinstance(found, ActiveCall) and found.answer is None:
            found.cancel()

    def made_for(self, session: str) -> list[ActiveCall]:
        """Running calls that are made by a session or a part of it, or on its behalf."""
        return [one for one in self._running.copy().values() if one.answer is None and _is_for(one.call, session)]

    def _drop_bodies(self) -> None:
        """Drops the oldest answers until the others are small enough together."""
        while self._bytes > MOST_BYTES:
            _, oldest = self._bodies.popitem(last=False)
            self._bytes -= len(oldest.answer[1])
            oldest.answer = _unknown(oldest.service)

    def _keep(self, key: Key, kept: KeptAnswer, expires_ns: int, now_ns: int) -> None:
        self._kept[key] = kept
        heappush(self._until, (expires_ns + GRACE_NS, key))
        self._evict(now_ns)

    def _evict(self, now_ns: int) -> None:
        """Forgets some calls that can no longer be repeated, and above the limit those that are nearest to that."""
        for _ in range(_FORGOTTEN_AT_ONCE):
            if not self._until or (self._until[0][0] >= now_ns and len(self._kept) <= MOST_CALLS):
                return
            until_ns, key = heappop(self._until)
            self._kept.pop(key, None)
            if key in self._bodies:
                self._bytes -= len(self._bodies.pop(key).answer[1])
            if until_ns >= now_ns:
                self._note_evicted(*key)

    def _note_evicted(self, caller: str, call_id: int) -> None:
        place = (caller, call_id >> 24)
        self._evicted[place] = max(call_id, self._evicted.pop(place, -1))
        if len(self._evicted) > _MOST_CALLERS:
            del self._evicted[next(iter(self._evicted))]


def _is_for(call: Call | None, session: str) -> bool:
    behalf = () if call is None or call.behalf is None else call.behalf.sessions
    return call is not None and any(within(one, session) for one in (call.session, *behalf))


@lru_cache(maxsize=256)
def _unknown(service: str) -> Answer:
    """Made once: a large answer may take the place of a thousand small ones."""
    return failed(OutcomeUnknown(service=service, deadline_s=0.0))


def cancelled(service: str) -> Answer:
    """The answer to a call that was cancelled before it began."""
    return failed(Cancelled(service=service))


def failed(error: BaseException) -> Answer:
    """The answer to a call that did not run."""
    return Status.ERROR, Raw(encode_message(pack_error(error)))


class ProgressReporter:
    """Sends the latest progress of each call, at most every 50 ms, on a thread of the timers.

    The last progress goes out before the answer. `Dispatcher._send_progress` sends it.
    """

    EVERY_NS: Final = 50_000_000

    def __init__(self, send: Callable[[ActiveCall, Raw], None], timers: Scheduler) -> None:
        self._send = send
        self._clock = timers.clock
        self._news = set[ActiveCall]()
        self._lock = threading.Lock()
        self._next_ns = 0
        """When it may send again."""
        self._task = timers.due(self._send_news)

    def report(self, ongoing: ActiveCall, body: Raw) -> None:
        """Sends this soon, unless newer progress replaces it."""
        with self._lock:
            ongoing.unsent = body
            self._news.add(ongoing)
        self._task.by(self._next_ns)

    def _send_news(self) -> int | None:
        with self._lock:
            now_ns = self._clock.now_ns()
            if now_ns < self._next_ns:
                return self._next_ns
            self._next_ns = now_ns + self.EVERY_NS
            news, self._news = self._news, set[ActiveCall]()
        for ongoing in news:
            self.send(ongoing)
        return None

    def send(self, ongoing: ActiveCall) -> None:
        """Sends the latest progress of a call, unless it was sent or the call has ended."""
        body = ongoing.unsent
        if body is None or ongoing.answer is not None:
            return
        self._send(ongoing, body)
        if ongoing.unsent is body:  # only now: better twice than never
            ongoing.unsent = None

    def close(self) -> None:
        """Sends no more. Idempotent."""
        self._task.cancel(_END_S)
