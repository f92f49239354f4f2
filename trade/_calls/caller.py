"""The caller's side of a call: borrow a reply channel, put the request, wait until it is answered, lost or too late.

A blocking caller waits on its reply channel itself, so no other thread is involved. A wait without an answer ends with
the container's own put on the reply key, at the deadline or from the thread that notices the callee's loss.
"""

import itertools
import logging
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from msgspec import Raw, structs

from trade._calls.arguments import ArgumentEncoder
from trade._calls.local_path import LocalPath, LocalSlot, LocalStarter
from trade._calls.peer import CallPublishers, OnReply, Peer, Pending, ReplySlot, Route, ended
from trade._calls.slot import Sent, Slot
from trade._telemetry.spans import Spans
from trade._threads.condition import InterruptibleCondition
from trade._threads.scheduler import NEVER, Scheduler
from trade.protocol.keys import CLOCK, DOMAIN, PROVIDER, Address, call_key, reply_key
from trade.protocol.messages import (
    CANCEL,
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
from trade.transport.base import ChannelClosed, Message, Publisher, Transport
from trade.transport.local_connection import ConnectionEnded

_logger = logging.getLogger("trade")
_CANCEL_S: Final = 2.0
_RESEND_S: Final = 0.25
"""How long a container that is back may take to answer before it is asked again; twice as long each time."""
_END_S: Final = 2.0
_GRANTING: Final = frozenset(("acquire", "renew"))
"""The services of locks whose answer counts only while its connection lasts: a callee that loses this container breaks
its connections off before it ends its locks. A process that was frozen would else take an old answer for a lock, which
another client has by now. For the same reason such a call is not sent again."""
_NEVER_RAN: Final = (Status.UNSENT, Status.BUSY, Status.GONE)


class Caller:
    """Sends the calls of one container.

    Args:
        transport: carries its calls.
        own: the container.
        timers: ends calls at their deadlines; its clock is theirs.
        local: carries its calls to containers of this host; none: the transport carries them, too.
    """

    def __init__(self, transport: Transport, own: Address, timers: Scheduler, local: LocalPath | None = None) -> None:
        self._transport = transport
        self._local = local
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
        self._clocks_due: dict[Peer, int] = {}
        """When to look whether the clock of a container was heard."""
        self._shared: ReplySlot | None = None
        self._threads: list[threading.Thread] = []
        self._closed = False
        self.leaving = False
        """Whether its container closes: the callees see that, and end its calls."""
        self.clock: Final = timers.clock
        """The clock of its deadlines."""
        self._deadlines = timers.due(self._end_overdue)
        self.malformed = 0
        self.spans: Spans | None = None
        """Records its calls while this container is traced."""

    @property
    def closed(self) -> bool:
        """Whether it sends no more calls."""
        return self._closed

    # --- what a call needs to know

    def peer(self, address: Address) -> Peer:
        """Another container; one without a liveliness token counts as lost."""
        return self._peers.get(address) or Peer(address, lost=True)

    def answers(self, address: Address) -> int:
        """The number of calls that a container has answered since it appeared."""
        return self.peer(address).answers

    def route(
        self, peer: Peer, domain: str, provider: str, *, stop: bool, arguments: ArgumentEncoder | None = None
    ) -> Route:
        """How calls reach a provider there. Raises ChannelClosed if the transport is closed."""
        key = call_key(self.own.identity, peer.address, domain, provider, stop=stop)
        middleware = (domain, provider) == (DOMAIN, PROVIDER)
        return Route(peer, self.publishers.get(key, stop=stop), key.encode(), stop, arguments, middleware)

    # --- calling

    def new_call(self, service: str, args: Raw) -> Call:
        """A call without a deadline that inherits nothing; its reply channel is set when it is sent."""
        return Call(PROTOCOL, self.new_id(), service, "", self.session, None, (), args)

    def ask(self, call: Call, route: Route, deadline_ns: int) -> Reply:
        """Sends a call and waits for its reply, which always comes, at the deadline from this container itself.

        The deadline is a time of its clock, as for `start` and `cancel`.
        """
        peer = route.peer
        local = peer.local
        if local is None:
            return self._ask(call, route, deadline_ns)
        if peer.unarrived and not route.stops and not self._reads_replies():
            before = tuple(peer.unarrived)
            reply = (self._ask_behind if local.starts() else self._ask)(call, route, deadline_ns)
            if reply.status < Status.TIMED_OUT:
                peer.unarrived.difference_update(before)
            return reply
        slot = local.borrow(deadline_ns, stops=route.stops)
        if slot is None:
            return self._ask(call, route, deadline_ns)
        try:
            return self._ask_locally(slot, call, route, deadline_ns)
        finally:
            slot.waiting = None
            local.take_back(slot)

    def _reads_replies(self) -> bool:
        """Whether this is a thread that the replies of started calls need, in the callback of one."""
        return self._deadlines.runs_here or threading.current_thread() in self._threads

    def _ask_behind(self, call: Call, route: Route, deadline_ns: int) -> Reply:
        """The same on the way that started calls took, so that it arrives after them."""
        replies: list[Reply] = []
        answered = InterruptibleCondition()

        def heard(reply: Reply) -> None:
            replies.append(reply)
            answered.notify_all()

        self.start(call, route, deadline_ns, heard)
        answered.wait_for(lambda: bool(replies), None)
        return replies[0]

    def _ask_locally(self, slot: LocalSlot, call: Call, route: Route, deadline_ns: int) -> Reply:
        """The same on a connection, or on the transport if that breaks."""
        peer = route.peer
        call.reply = slot.name
        parts = route.encode_parts(call)
        self._wait_with(slot, (call.id, peer, deadline_ns))
        if peer.lost or self._closed:
            return ended(call.id, Status.UNSENT)
        sent_ns = time.monotonic_ns()
        try:
            slot.whole = False
            slot.connection.send(*parts, key=route.key)
            reply = self._await_locally(slot, call.id)
            if _grants(call, route) and slot.connection.ended_there:
                raise ConnectionEnded
            slot.whole = slot.answered = True
        except ConnectionEnded:
            if slot.ended_id == call.id:
                return ended(call.id, slot.ended_status)
            if _grants(call, route):
                return ended(call.id, Status.LOST)
            return self._ask_again(decode_call(b"".join(parts)), route, deadline_ns)
        peer.heard(reply.clock_ns, sent_ns, time.monotonic_ns())
        return reply

    def _ask_again(self, call: Call, route: Route, deadline_ns: int) -> Reply:
        """Sends a call on the transport that may have been sent already."""
        again = Route(route.peer, route.publisher, route.key, stops=route.stops)
        return self._of_repeated(self._ask(call, again, deadline_ns))

    def _of_repeated(self, reply: Reply) -> Reply:
        """The reply to a call that was sent twice: where the second one did not run, the first one may have."""
        if reply.status in _NEVER_RAN:
            return ended(reply.id, Status.CLOSED if self._closed else Status.LOST)
        return reply

    def _await_locally(self, slot: LocalSlot, call_id: int) -> Reply:
        """Waits for the answer; a blocking caller does not read progress. Raises ConnectionEnded."""
        while True:
            try:
                reply = decode_reply(slot.connection.receive()[1])
            except Malformed as bad:
                self._note_malformed(slot.name, bad)
                raise ConnectionEnded from None
            if reply.id == call_id and reply.status < Status.PROGRESS:
                return reply

    def _wait_with(self, slot: Slot, waiting: tuple[int, Peer, int]) -> None:
        slot.waiting = waiting
        self._deadlines.by(waiting[2])

    def _ask(self, call: Call, route: Route, deadline_ns: int) -> Reply:
        """The same on the transport."""
        try:
            slot = self._borrow()
        except ChannelClosed:
            return ended(call.id, Status.UNSENT)
        peer, publisher = route.peer, route.publisher
        try:
            call.reply = slot.name
            data = route.encode(call)
            slot.sent = (publisher, data)
            self._wait_with(slot, (call.id, peer, deadline_ns))
            if peer.lost or self._closed:
                return ended(call.id, Status.UNSENT)
            sent_ns = time.monotonic_ns()
            publisher.put(data)
            return self._await_reply(slot, call.id, peer, sent_ns)
        except ChannelClosed:  # the publisher closed with its provider, or the whole container closes
            return ended(call.id, Status.UNSENT)
        finally:
            slot.waiting = slot.sent = None
            self._free.append(slot)

    def _await_reply(self, slot: ReplySlot, call_id: int, peer: Peer, sent_ns: int) -> Reply:
        while True:
            try:
                message = slot.channel.receive()
            except ChannelClosed:
                return ended(call_id, Status.CLOSED)
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
        peer, publisher = route.peer, route.publisher
        local = peer.local
        starter = None if local is None else local.starter(deadline_ns, stops=route.stops, begin=self._begin_reading)
        try:
            call.reply = self._shared_box().name if starter is None else starter.name
        except ChannelClosed:
            on_reply(ended(call.id, Status.UNSENT))
            return
        data = route.encode(call)
        grants, sent = _grants(call, route), (publisher, data)
        pending = Pending(peer, deadline_ns, on_reply, on_progress, sent, starter, grants=grants)
        self._pending[call.id] = pending
        self._deadlines.by(deadline_ns)
        if peer.lost or self._closed:
            self._finish(ended(call.id, Status.UNSENT))
            return
        try:
            if starter is None:
                publisher.put(data)
            else:
                starter.send(data, route.key)
            if local is not None and not route.stops and call.id in self._pending:
                peer.unarrived.add(call.id)
        except ChannelClosed:
            self._finish(ended(call.id, Status.UNSENT))
        except ConnectionEnded:
            self._start_again(call.id, pending, starter)

    def _start_again(self, call_id: int, pending: Pending, starter: LocalStarter | None) -> None:
        """Sends a started call on the transport, after the connection that it took has ended."""
        if pending.grants:
            self._finish(ended(call_id, Status.LOST))
            return
        with self._lock:
            if pending.starter is not starter or call_id not in self._pending:  # another thread does, or it has ended
                return
            pending.starter, pending.again = None, True
        publisher, data = pending.sent
        call = decode_call(data)
        try:
            if not (pending.peer.lost or self._closed):
                call.reply = self._shared_box().name
                data = encode_message(call)
                pending.sent = (publisher, data)
                publisher.put(data)
                return
        except ChannelClosed:
            _logger.debug("%s is not sent again, because its provider is gone", call.service)
        self._finish(ended(call_id, Status.UNSENT))

    def _begin_reading(self, starter: LocalStarter) -> None:
        self._spawn("trade-local-replies", lambda: self._read_started(starter))

    def _read_started(self, starter: LocalStarter) -> None:
        try:
            while True:
                reply = self._decode(Message(starter.name, starter.receive()))
                pending = None if reply is None else self._pending.get(reply.id)
                if reply is None or pending is None or pending.starter is not starter:
                    continue
                if pending.grants and starter.ended_there:
                    return
                if reply.status < Status.TIMED_OUT:  # only this container ends a wait itself
                    self._take_reply(reply, pending)
        except (ConnectionEnded, Malformed):
            return
        finally:
            starter.end()
            for call_id, pending in self._pending.copy().items():
                if pending.starter is starter:
                    self._start_again(call_id, pending, starter)
            with self._lock, suppress(ValueError):
                self._threads.remove(threading.current_thread())

    def _take_reply(self, reply: Reply, pending: Pending) -> None:
        if reply.status != Status.PROGRESS:
            self._finish(reply)
        elif pending.on_progress is not None:
            pending.on_progress(reply)

    def cancel(self, peer: Peer, call_id: int, service: str, deadline_ns: int) -> None:
        """Asks the callee to end a call, or not to begin it; does not wait."""
        now = self.clock.now_ns()
        if call_id not in self._pending or now >= deadline_ns:
            return
        asked = Raw(encode_message(CancelArguments(call_id, service, min(86_400.0, (deadline_ns - now) / 1e9))))
        route = self.route(peer, DOMAIN, PROVIDER, stop=True)
        self.start(self.new_call(CANCEL, asked), route, now + int(_CANCEL_S * 1e9), lambda _: None)

    # --- sending again

    def resend(self, peer: Peer) -> None:
        """Sends pending calls again after a lost link to the same epoch is back: same ids, no later deadlines.

        The callee runs no id twice. Its clock is requested first, as it may have been suspended meanwhile, and again
        until it answers: beyond a bridge, its sign of life may be back before the routes of calls and answers are.
        """
        peer.returns += 1
        if peer.clock_known or self._unanswered(peer):
            self._ask_before_resending(peer, peer.returns, _RESEND_S)

    def expect_clock(self, peer: Peer) -> None:
        """Requests the clock of a container, which a first call requests, again if it does not answer soon."""
        due_ns = self.clock.now_ns() + int(_RESEND_S * 1e9)
        if self._clocks_due.setdefault(peer, due_ns) == due_ns:
            self._deadlines.by(due_ns)

    def _look_at_clocks(self, now_ns: int) -> None:
        for peer, due_ns in self._clocks_due.copy().items():
            if due_ns <= now_ns:
                del self._clocks_due[peer]
                if not (peer.clock_known or peer.lost):
                    self._ask_before_resending(peer, peer.returns, _RESEND_S)

    def _ask_before_resending(self, peer: Peer, returned: int, wait_s: float) -> None:
        try:
            clock = self.route(peer, DOMAIN, PROVIDER, stop=False)
        except ChannelClosed:  # meanwhile
            return

        def clock_heard(reply: Reply) -> None:
            if reply.status == Status.OK:
                for publisher, data in self._unanswered(peer):
                    self._put_again(peer, publisher, decode_call(data))
                return
            again = reply.status == Status.TIMED_OUT and peer.returns == returned
            if again and (wait_s < _CANCEL_S or self._unanswered(peer)):
                self._ask_before_resending(peer, returned, min(2 * wait_s, _CANCEL_S))

        until_ns = self.clock.now_ns() + int(wait_s * 1e9)
        self.start(self.new_call(CLOCK, EMPTY_ARGUMENTS), clock, until_ns, clock_heard)

    def _unanswered(self, peer: Peer) -> list[Sent]:
        """The calls to it that wait for an answer from the transport."""
        sent = [slot.sent for slot in list(self._every) if slot.waiting is not None and slot.waiting[1] is peer]
        started = [pending for pending in list(self._pending.values()) if pending.peer is peer]
        return [one for one in (*sent, *(each.sent for each in started if each.starter is None)) if one is not None]

    def _put_again(self, peer: Peer, publisher: Publisher, call: Call) -> None:
        deadline_ns = self._deadline_of(call.id)
        if deadline_ns is None:  # answered meanwhile
            return
        expires_ns = call.expires_ns
        if expires_ns is not None:
            expires_ns = min(expires_ns, peer.expiry_ns(deadline_ns - self.clock.ahead_ns) or 0)
        try:
            publisher.put(encode_message(structs.replace(call, expires_ns=expires_ns)))
        except ChannelClosed:
            _logger.debug("%s is not sent again, because its provider is gone", call.service)

    def _deadline_of(self, call_id: int) -> int | None:
        pending = self._pending.get(call_id)
        if pending is not None:
            return pending.deadline_ns
        waiting = [slot.waiting for slot in list(self._every)]
        return next((one[2] for one in waiting if one is not None and one[0] == call_id), None)

    def _finish(self, reply: Reply) -> None:
        pending = self._pending.pop(reply.id, None)
        if pending is None:
            return
        pending.peer.unarrived.discard(reply.id)
        if pending.again:
            reply = self._of_repeated(reply)
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
            name = f"{self.own.container}/{index}"
            slot = ReplySlot(name, self._transport, own, self._transport.subscribe(key))
            self._every.append(slot)
            return slot

    def _shared_box(self) -> ReplySlot:
        if self._shared is None:
            slot = self._new_reply_slot()
            with self._lock:
                if self._shared is None:
                    self._shared = slot
                    try:
                        self._spawn("trade-replies", self._read_shared)
                    except RuntimeError:
                        self._shared = None
                        raise
                    return slot
            self._free.append(slot)
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
            self._take_reply(reply, pending)

    def _decode(self, message: Message) -> Reply | None:
        try:
            return decode_reply(message.payload or b"")
        except Malformed as bad:
            self._note_malformed(message.key, bad)
            return None

    def _note_malformed(self, where: str, bad: Malformed) -> None:
        self.malformed += 1
        if self.malformed == 1:
            _logger.warning("dropped an answer on %s: %s", where, bad)

    # --- ends without an answer

    def lost(self, address: Address, *, back: bool = False) -> None:
        """Ends the calls that wait for a lost container, or sends them again when it is back.

        A lost peer is forgotten with its clock, which may stop while it is unreachable, as on a suspended computer.
        """
        if back:
            local = None if self._local is None else self._local.to(address)
            self.resend(self._peers.setdefault(address, Peer(address, local=local)))
        elif (peer := self._peers.pop(address, None)) is not None:
            peer.lost = True
            peer.close()
            self._end(lambda waiting, _: waiting is peer, Status.LOST)

    def _end_overdue(self) -> float:
        """Ends the calls that are too late, and looks whether clocks were heard; returns when that is due next."""
        now_ns = self.clock.now_ns()
        self._look_at_clocks(now_ns)
        self.clock.give_time(lambda: self._next_deadline_ns() <= now_ns)
        self._end(lambda _, deadline_ns: deadline_ns <= now_ns, Status.TIMED_OUT)
        return self._next_deadline_ns()

    def _next_deadline_ns(self) -> float:
        waiting = [(slot.waiting, slot.ended_id) for slot in self._slots()]
        blocked = [call[2] for call, ended_id in waiting if call is not None and call[0] != ended_id]
        started = [pending.deadline_ns for pending in list(self._pending.values())]
        return min([*blocked, *started, *self._clocks_due.copy().values()], default=NEVER)

    def _end(self, meant: Callable[[object, float], bool], status: int) -> None:
        for slot in self._slots():
            waiting = slot.waiting
            if waiting is None:
                continue
            call_id, peer, deadline_ns = waiting
            if call_id != slot.ended_id and meant(peer, deadline_ns):
                slot.end(call_id, status)
        for call_id, pending in self._pending.copy().items():  # list(...items()) is not atomic
            if meant(pending.peer, pending.deadline_ns):
                self._finish(ended(call_id, status))

    def _slots(self) -> list[Slot]:
        return [*self._every, *(() if self._local is None else self._local.slots)]

    def _spawn(self, name: str, target: Callable[[], None]) -> None:
        thread = threading.Thread(target=target, name=name, daemon=True)
        self._threads.append(thread)
        try:
            thread.start()
        except RuntimeError:  # the process may have no more threads
            self._threads.remove(thread)
            raise

    def finish_stops(self, limit_s: float) -> None:
        """Waits, as the container closes, until no stop is under way, at most ``limit_s`` seconds."""
        self.leaving = True
        if self._reads_replies():
            return
        until = time.monotonic() + limit_s
        while self._stopping() and time.monotonic() < until:
            time.sleep(0.001)

    def _stopping(self) -> bool:
        sent = [slot.sent for slot in list(self._every)] + [pending.sent for pending in list(self._pending.values())]
        local = () if self._local is None else list(self._local.slots)
        return any(one is not None and self.publishers.of_stops(one[0]) for one in sent) or any(
            slot.stops and slot.waiting is not None for slot in local
        )

    def close(self) -> None:
        """Ends every wait and every thread. Idempotent."""
        self._closed = True
        self._end(lambda _peer, _deadline: True, Status.CLOSED)
        self._wait_until_free(time.monotonic() + _END_S)
        for slot in list(self._every):
            slot.channel.close()
        if self._local is not None:
            self._local.close()
        for peer in list(self._peers.values()):
            peer.close()
        self._deadlines.cancel(_END_S)
        for thread in list(self._threads):
            if thread is not threading.current_thread():
                thread.join(_END_S)
        self.publishers.close()

    def _wait_until_free(self, deadline: float) -> None:
        """Waits until no thread is inside the transport: otherwise the end of the interpreter would abort it."""
        while any(slot.waiting is not None for slot in self._slots()) and time.monotonic() < deadline:
            time.sleep(0.001)


def _grants(call: Call, route: Route) -> bool:
    """Whether its answer may grant a lock, or renew one."""
    return route.middleware and call.service in _GRANTING
