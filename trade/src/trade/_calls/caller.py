"""The caller's side of a call: borrow a reply channel, put the request, wait until it is answered, lost or too late.

A blocking caller waits on its reply channel itself, so no other thread is involved. A wait without an answer ends with
the container's own put on the reply key, from the deadline thread or from the thread that notices the callee's loss.
"""

import itertools
import logging
import secrets
import threading
import time
from collections.abc import Callable
from typing import Final

from msgspec import Raw, structs

from trade._calls.peer import NEVER, CallPublishers, OnReply, Peer, Pending, ReplySlot, Route
from trade._protocol.keys import CLOCK, DOMAIN, PROVIDER, Address, reply_key
from trade._protocol.messages import (
    CANCEL,
    EMPTY,
    EMPTY_ARGUMENTS,
    PROTOCOL,
    Call,
    CancelArguments,
    Malformed,
    Reply,
    Status,
    decode_call,
    decode_reply,
    encode_message,
)
from trade._telemetry.spans import Spans
from trade._transport.base import ChannelClosed, Message, Publisher, Transport

_logger = logging.getLogger("trade")
_CANCEL_S: Final = 2.0


class Caller:
    """Sends the calls of one container."""

    def __init__(self, transport: Transport, own: Address) -> None:
        self._transport = transport
        self.own: Final = own
        """The container that calls."""
        self.session: Final = str(own)
        """The session of its calls, unless it acts for a client."""
        self._ends_on = f"reply/{own.identity}/"
        self.new_id: Callable[[], int] = itertools.count(secrets.randbits(38) << 24 | 1).__next__
        self._peers: dict[Address, Peer] = {}
        self.publishers: Final = CallPublishers(transport, own.identity)
        self._lock = threading.Lock()
        self._every: list[ReplySlot] = []
        self._free: list[ReplySlot] = []
        self._pending: dict[int, Pending] = {}
        self._shared: ReplySlot | None = None
        self._threads: list[threading.Thread] = []
        self._closed = False
        self.leaving = False
        """Whether its container closes: the callees see that, and end its calls."""
        self._next_deadline_ns: float = NEVER
        self._sooner = threading.Event()
        self.malformed = 0
        self.spans: Spans | None = None
        """Records its calls while this container is traced."""
        self._spawn("trade-deadlines", self._watch_deadlines)

    @property
    def closed(self) -> bool:
        """Whether it sends no more calls."""
        return self._closed

    # --- what a call needs to know

    def peer(self, address: Address) -> Peer:
        """Another container; one without a liveliness token counts as lost."""
        return self._peers.get(address) or Peer(address, lost=True)

    # --- calling

    def new_call(self, service: str, args: Raw) -> Call:
        """A call without a deadline that inherits nothing; its reply channel is set when it is sent."""
        return Call(PROTOCOL, self.new_id(), service, "", self.session, None, (), args)

    def ask(self, call: Call, route: Route, deadline_ns: int) -> Reply:
        """Sends a call and waits for its reply, which always comes, at the deadline from this container itself."""
        try:
            box = self._borrow()
        except ChannelClosed:
            return _ended(call.id, Status.UNSENT)
        peer, publisher = route.peer, route.publisher
        try:
            call.reply = box.name
            data = route.encode(call)
            box.sent = (publisher, data)
            box.waiting = (call.id, peer, deadline_ns)
            if deadline_ns < self._next_deadline_ns:
                self._sooner.set()
            if peer.lost or self._closed:
                return _ended(call.id, Status.UNSENT)
            sent_ns = time.monotonic_ns()
            publisher.put(data)
            return self._await_reply(box, call.id, peer, sent_ns)
        except ChannelClosed:  # the publisher closed with its provider, or the whole container closes
            return _ended(call.id, Status.UNSENT)
        finally:
            box.waiting = box.sent = None
            self._free.append(box)

    def _await_reply(self, box: ReplySlot, call_id: int, peer: Peer, sent_ns: int) -> Reply:
        while True:
            try:
                message = box.channel.receive()
            except ChannelClosed:
                return _ended(call_id, Status.CLOSED)
            reply = self._decode(message)
            if reply is None or reply.id != call_id or not self._may_answer(message, peer, reply):
                continue
            if reply.status == Status.PROGRESS:  # a blocking caller does not read progress
                continue
            if reply.status < Status.TIMED_OUT:
                peer.heard(reply.clock_ns, sent_ns, time.monotonic_ns())
            return reply

    def _may_answer(self, message: Message, peer: Peer, reply: Reply) -> bool:
        """Only the callee may answer, and only this container may end the wait; the key names the sender."""
        return message.key.startswith(self._ends_on if reply.status >= Status.TIMED_OUT else peer.answers_on)

    def start(
        self, call: Call, route: Route, deadline_ns: int, on_reply: OnReply, on_progress: OnReply | None = None
    ) -> None:
        """Sends a call without waiting; the callbacks get its reply and progress on another thread."""
        try:
            call.reply = self._shared_box().name
        except ChannelClosed:
            on_reply(_ended(call.id, Status.UNSENT))
            return
        peer, publisher, data = route.peer, route.publisher, route.encode(call)
        self._pending[call.id] = Pending(peer, deadline_ns, on_reply, on_progress, (publisher, data))
        if deadline_ns < self._next_deadline_ns:
            self._sooner.set()
        if peer.lost or self._closed:
            self._finish(_ended(call.id, Status.UNSENT))
            return
        try:
            publisher.put(data)
        except ChannelClosed:
            self._finish(_ended(call.id, Status.UNSENT))

    def cancel(self, peer: Peer, call_id: int, service: str, deadline_ns: int) -> None:
        """Asks the callee to end a call, or not to begin it; does not wait."""
        now = time.monotonic_ns()
        if call_id not in self._pending or now >= deadline_ns:
            return
        asked = Raw(encode_message(CancelArguments(call_id, service, min(86_400.0, (deadline_ns - now) / 1e9))))
        route = Route(peer, self.publishers.get(peer.address, DOMAIN, PROVIDER, stop=True))
        self.start(self.new_call(CANCEL, asked), route, now + int(_CANCEL_S * 1e9), lambda _: None)

    # --- sending again

    def resend(self, peer: Peer) -> None:
        """Sends pending calls again after a lost link to the same epoch is back: same ids, no later deadlines.

        The callee runs no id twice. Its clock is requested first, as it may have been suspended meanwhile.
        """
        sent = [box.sent for box in list(self._every) if box.waiting is not None and box.waiting[1] is peer]
        sent += [pending.sent for pending in list(self._pending.values()) if pending.peer is peer]
        due = [one for one in sent if one is not None]
        if due:
            clock = Route(peer, self.publishers.get(peer.address, DOMAIN, PROVIDER, stop=False))
            soon = time.monotonic_ns() + int(_CANCEL_S * 1e9)

            def clock_heard(reply: Reply) -> None:
                if reply.status == Status.OK:
                    for publisher, data in due:
                        self._put_again(peer, publisher, decode_call(data))

            self.start(self.new_call(CLOCK, EMPTY_ARGUMENTS), clock, soon, clock_heard)

    def _put_again(self, peer: Peer, publisher: Publisher, call: Call) -> None:
        deadline_ns = self._deadline_of(call.id)
        if deadline_ns is None:  # answered meanwhile
            return
        expires_ns = call.expires_ns
        if expires_ns is not None:
            expires_ns = min(expires_ns, peer.expiry_ns(deadline_ns) or 0)
        try:
            publisher.put(encode_message(structs.replace(call, expires_ns=expires_ns)))
        except ChannelClosed:
            _logger.debug("%s is not sent again, because its provider is gone", call.service)

    def _deadline_of(self, call_id: int) -> int | None:
        pending = self._pending.get(call_id)
        if pending is not None:
            return pending.deadline_ns
        waiting = [box.waiting for box in list(self._every)]
        return next((one[2] for one in waiting if one is not None and one[0] == call_id), None)

    def _finish(self, reply: Reply) -> None:
        pending = self._pending.pop(reply.id, None)
        if pending is None:
            return
        if reply.status < Status.TIMED_OUT:
            pending.peer.heard(reply.clock_ns, pending.sent_ns, time.monotonic_ns())
        try:
            pending.on_reply(reply)
        except Exception:
            _logger.exception("the callback of an answer failed")

    # --- reply channels

    def _borrow(self) -> ReplySlot:
        try:
            return self._free.pop()
        except IndexError:
            return self._new_reply_slot()

    def _new_reply_slot(self) -> ReplySlot:
        with self._lock:
            index = f"{self.own.epoch}-{len(self._every)}"  # another container may have the same name
            key = reply_key("*", self.own.identity, self.own.container, index)
            own = reply_key(self.own.identity, self.own.identity, self.own.container, index)
            box = ReplySlot(f"{self.own.container}/{index}", own, self._transport.subscribe(key))
            self._every.append(box)
            return box

    def _shared_box(self) -> ReplySlot:
        if self._shared is None:
            box = self._new_reply_slot()
            with self._lock:
                if self._shared is None:
                    self._shared = box
                    self._spawn("trade-replies", self._read_shared)
                    return box
            self._free.append(box)
        return self._shared

    def _read_shared(self) -> None:
        assert self._shared is not None  # noqa: S101
        while True:
            try:
                message = self._shared.channel.receive()
            except ChannelClosed:
                return
            reply = self._decode(message)
            pending = self._pending.get(reply.id) if reply is not None else None
            if reply is None or pending is None or not self._may_answer(message, pending.peer, reply):
                continue
            if reply.status != Status.PROGRESS:
                self._finish(reply)
            elif pending.on_progress is not None:
                pending.on_progress(reply)

    def _decode(self, message: Message) -> Reply | None:
        try:
            return decode_reply(message.payload or b"")
        except Malformed as bad:
            self.malformed += 1
            if self.malformed == 1:
                _logger.warning("dropped an answer on %s: %s", message.key, bad)
            return None

    # --- ends without an answer

    def lost(self, address: Address, *, back: bool = False) -> None:
        """Ends the calls that wait for a lost container, or sends them again when it is back.

        A lost peer is forgotten with its clock, which may stop while it is unreachable, as on a suspended computer.
        """
        if back:
            self.resend(self._peers.setdefault(address, Peer(address)))
        elif (peer := self._peers.pop(address, None)) is not None:
            peer.lost = True
            self._end(lambda waiting, _: waiting is peer, Status.LOST)

    def _watch_deadlines(self) -> None:
        while not self._closed:
            self._sooner.clear()
            self._next_deadline_ns = NEVER  # a call that starts during the scan wakes this thread
            now = time.monotonic_ns()
            self._end_overdue(now)
            soonest = min(self._deadlines(), default=NEVER)
            self._next_deadline_ns = soonest
            self._sooner.wait(None if soonest == NEVER else max(0.0, (soonest - now) / 1e9))

    def _deadlines(self) -> list[int]:
        waiting = [(box.waiting, box.ended_id) for box in list(self._every)]
        blocked = [call[2] for call, ended_id in waiting if call is not None and call[0] != ended_id]
        return blocked + [pending.deadline_ns for pending in list(self._pending.values())]

    def _end_overdue(self, now_ns: int) -> None:
        self._end(lambda _, deadline_ns: deadline_ns <= now_ns, Status.TIMED_OUT)

    def _end(self, meant: Callable[[Peer, float], bool], status: int) -> None:
        for box in list(self._every):
            waiting = box.waiting
            if waiting is None:
                continue
            call_id, peer, deadline_ns = waiting
            if call_id != box.ended_id and meant(peer, deadline_ns):
                box.ended_id = call_id
                self._transport.wake(box.wake_key, encode_message(_ended(call_id, status)))
        for call_id, pending in self._pending.copy().items():  # list(...items()) is not atomic
            if meant(pending.peer, pending.deadline_ns):
                self._finish(_ended(call_id, status))

    def _spawn(self, name: str, target: Callable[[], None]) -> None:
        thread = threading.Thread(target=target, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def finish_stops(self, limit_s: float) -> None:
        """Waits, as the container closes, until no stop is under way, at most ``limit_s`` seconds."""
        self.leaving = True
        if threading.current_thread() in self._threads:  # the thread that their replies need
            return
        until = time.monotonic() + limit_s
        while self._stopping() and time.monotonic() < until:
            time.sleep(0.001)

    def _stopping(self) -> bool:
        sent = [box.sent for box in list(self._every)] + [pending.sent for pending in list(self._pending.values())]
        return any(one is not None and self.publishers.of_stops(one[0]) for one in sent)

    def close(self) -> None:
        """Ends every wait and every thread. Idempotent."""
        self._closed = True
        self._sooner.set()
        self._end(lambda _peer, _deadline: True, Status.CLOSED)
        self._wait_until_free(time.monotonic() + 2)
        for box in list(self._every):
            box.channel.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(2)
        self.publishers.close()

    def _wait_until_free(self, deadline: float) -> None:
        """Waits until no thread is inside the transport: otherwise the end of the interpreter would abort it."""
        while any(box.waiting is not None for box in list(self._every)) and time.monotonic() < deadline:
            time.sleep(0.001)


def _ended(call_id: int, status: int) -> Reply:
    return Reply(PROTOCOL, call_id, status, 0, EMPTY)
