"""Polls what cannot be subscribed to: traced calls, locks, health and e-stops, on its own thread."""

import contextlib
import queue
import threading
import time
from collections.abc import Collection, Iterator
from typing import Final

from trade import Container, Handle, LockInfo, Outcome, Span, where
from trade.errors import AccessDenied, TradeError
from trade_gateway.recording._channels import (
    CALLS,
    FAULTS,
    LOCKS,
    Call,
    Channel,
    Fault,
    FaultKind,
    Lock,
    Locks,
    Message,
    encoded,
)
from trade_gateway.recording._sources import within
from trade_gateway.recording._timeline import Timeline

_EVERY_S: Final = 0.2
_ASKED_S: Final = 1.0
"""How long to wait for a container's answer before continuing without it, in seconds."""
_LOCKS_AGAIN_S: Final = 5.0
"""Period in which all locks are recorded even if unchanged, so that every part of a recording has them."""
_TAKES_AND_GIVES: Final = ("trade.acquire", "trade.release")
_HEALTHY: Final = "healthy"
_END_S: Final = 15.0


class Watch:
    """Polls several times a second, and keeps the results until they are taken."""

    def __init__(self, container: Container, groups: list[str], wake: threading.Event, timeline: Timeline) -> None:
        self._container = container
        self._timeline = timeline
        self._since: dict[tuple[str, str, float], float] = {}
        """Begins of locks, by container, owner and the wall clock of that moment."""
        self._groups = groups
        self._wake = wake
        self._messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._calls = _Calls(container, groups)
        self._locks: list[Lock] | None = None
        self._locks_at = 0.0
        self._health: dict[str, str] = {}
        self._estops: dict[str, str] = {}
        self._looked = False
        self._end = threading.Event()
        self.refused = ""
        """Why calls are not recorded; empty: they are."""
        self._thread = threading.Thread(target=self._run, name="trade-record-watch", daemon=True)
        self._thread.start()

    def take(self) -> Iterator[Message]:
        """Yields the results since the last time, without their time of arrival."""
        with contextlib.suppress(queue.Empty):
            while True:
                yield self._messages.get_nowait()

    def _run(self) -> None:
        while not self._end.is_set():
            self._look()
            self._end.wait(_EVERY_S)
        self._look()

    def _look(self) -> None:
        for look in (self._look_at_health, self._look_at_calls, self._look_at_locks):
            try:
                look()
            except AccessDenied as denied:
                self.refused = str(denied)
            except TradeError:  # a container may shut down meanwhile
                continue
        self._wake.set()

    def _put(self, channel: Channel, stamp_s: float, value: object) -> None:
        self._messages.put(Message(channel, 0, max(0, int(stamp_s * 1e9)), encoded(value)))

    def _look_at_calls(self) -> None:
        for span in self._calls.read():
            ended_s = self._timeline.of(span.began + span.took_s)
            self._put(CALLS, ended_s, _call(span, ended_s - span.took_s))

    def _look_at_locks(self) -> None:
        known, used = self._container.lock_api.known(), self._used()
        shown = [info for info in known.locks if self._about(info.resources) or used & set(info.resources)]
        locks = [_lock(info, self._began(info)) for info in shown]
        locks += [lock for lock in self._locks or () if known.still(lock.container)]
        now = time.monotonic()
        if locks != self._locks or now - self._locks_at >= _LOCKS_AGAIN_S:
            self._locks, self._locks_at = locks, now
            self._put(LOCKS, self._timeline.now_s(), Locks(locks=locks))

    def _began(self, info: LockInfo) -> float:
        """Converts the begin of a lock as soon as the lock is seen, before the clock can step again."""
        key = info.container, info.holder.owner, info.holder.since
        if key not in self._since:
            self._since[key] = self._timeline.of(info.holder.since)
        return self._since[key]

    def _used(self) -> set[str]:
        """The resources of the recorded services: those of a joint group have names of other groups."""
        found = self._container.services(~where(group="trade"))
        return {name for handle in found if within(handle.label, self._groups) for name in handle.resources}

    def _about(self, resources: tuple[str, ...]) -> bool:
        return any(within(resource, self._groups) or _above(resource, self._groups) for resource in resources)

    def _look_at_health(self) -> None:
        now = {
            handle.groups[0]: handle.health
            for handle in self._container.services(~where(group="trade"))
            if handle.groups and within(handle.label, self._groups)
        }
        for group in self._health.keys() - now.keys():
            self._changed(group, "gone", "its services have gone")
        for group, health in now.items():
            if health != self._health.get(group, _HEALTHY):
                self._changed(group, "health", "" if health == _HEALTHY else health)
        self._health = now
        estops = {estop.id: f"{estop.reason} (by {estop.giver})" for estop in self._container.estops()}
        for known in self._estops.keys() - estops.keys():
            self._changed(f"e-stop {known}", "e-stop", "")
        for known in estops.keys() - self._estops.keys():
            self._changed(f"e-stop {known}", "e-stop", estops[known])
        self._estops, self._looked = estops, True

    def _changed(self, about: str, kind: FaultKind, text: str) -> None:
        self._put(FAULTS, self._timeline.now_s(), Fault(about=about, kind=kind, text=text, new=self._looked))

    def close(self) -> None:
        """Polls once more, and turns off the tracing that it turned on. Idempotent."""
        self._end.set()
        self._thread.join(_END_S)
        self._calls.close()


class _Calls:
    """Turns on tracing in containers, and reads each traced call once."""

    def __init__(self, container: Container, groups: list[str]) -> None:
        self._container = container
        self._groups = groups
        self._switched: list[Handle] = []
        """Containers that did not trace before."""
        self._read: dict[Handle, int] = {}
        """For each container, the number of the last call read."""

    def read(self) -> list[Span]:
        """Returns the calls traced since the last time, also of new containers."""
        asked = [handle.with_(deadline_s=_ASKED_S) for handle in self._services("spans")]
        new = [handle for handle in asked if handle not in self._read]
        outcomes = self._container.call_all([handle.bind(None, self._read.get(handle, 0)) for handle in asked])
        spans: list[Span] = []
        for outcome in outcomes:
            _refuse(outcome)
            if outcome.ok:
                noted: list[Span] = outcome.result
                spans += [] if outcome.handle in new else noted
                last = self._read.get(outcome.handle, 0)
                self._read[outcome.handle] = noted[-1].number if noted else last
        if new:
            self._have_noted({handle.key.address for handle in new if handle in self._read})
        reading = {handle.label for handle in self._container.services() if handle.effect == "read"}
        return [span for span in spans if self._is_recorded(span, reading)]

    def _services(self, name: str) -> list[Handle]:
        return [one for one in self._container.services(where(name=name, group="trade")) if not one.local]

    def _have_noted(self, addresses: Collection[object]) -> None:
        switches = [one for one in self._services("set_tracing") if one.key.address in addresses]
        for outcome in self._container.call_all([one.with_(deadline_s=_ASKED_S).bind(True) for one in switches]):
            _refuse(outcome)
            if outcome.ok and not outcome.result:
                self._switched.append(outcome.handle)

    def _is_recorded(self, span: Span, reading: Collection[str]) -> bool:
        """Whether a call is recorded: not a container's own reads, which sample its streams."""
        sampled = span.side == "served" and not (span.calls or span.remote) and span.service in reading
        return not sampled and (span.service in _TAKES_AND_GIVES or within(span.service, self._groups))

    def close(self) -> None:
        """Restores the tracing of every container. Idempotent."""
        calls = [handle.with_(deadline_s=_ASKED_S).bind(False) for handle in self._switched if handle.alive]
        self._switched.clear()
        self._container.call_all(calls)


def _refuse(outcome: Outcome) -> None:
    if isinstance(outcome.error, AccessDenied):
        raise outcome.error


def _call(span: Span, began_s: float) -> Call:
    return Call(
        call_id=str(span.call_id),
        calls=[str(call) for call in span.calls],
        service=span.service,
        side=span.side,
        container=span.container,
        caller=span.caller,
        session=span.session,
        began_s=began_s,
        waited_s=span.waited_s,
        took_s=span.took_s,
        outcome=span.outcome,
        locks=list(span.locks),
    )


def _lock(info: LockInfo, since_s: float) -> Lock:
    return Lock(
        container=info.container,
        resources=list(info.resources),
        owner=info.holder.owner,
        purpose=info.holder.purpose,
        since_s=since_s,
        waiting=list(info.waiting),
    )


def _above(resource: str, groups: list[str]) -> bool:
    return any(within(group, [resource]) for group in groups)
