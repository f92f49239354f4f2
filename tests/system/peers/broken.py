"""Containers that break one rule each: what `trade conformance` has to notice."""

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec

from trade._calls import client
from trade._context import active_calls
from trade._discovery.announcer import Announcer
from trade._estop import broadcast, latch, store
from trade._estop.deadman import Deadman
from trade._resources import lock_table, resource
from trade._services import local_service
from trade._services.dispatcher import Dispatcher
from trade.protocol import estop_messages, messages


def _put(where: Any, name: str, instead: Any) -> Callable[[], None]:
    return lambda: setattr(where, name, instead)


def _as_if_new(
    self: active_calls.CallDeduplicator, call: messages.Call, ongoing: active_calls.ActiveCall
) -> active_calls.ActiveCall:
    return ongoing


_end: Any = active_calls.CallDeduplicator.end


def _end_in_64_bits(
    self: active_calls.CallDeduplicator, ongoing: Any, call: messages.Call, answer: Any, *, keep: bool
) -> Any:
    wrapped = ((call.expires_ns or 0) + active_calls.GRACE_NS + 2**63) % 2**64 - 2**63
    return _end(
        self, ongoing, msgspec.structs.replace(call, expires_ns=wrapped - active_calls.GRACE_NS), answer, keep=keep
    )


def _confirm_only(self: latch.EstopLatch, order: messages.EstopOrder, who: str) -> None:
    self._confirm(order.request, "")


def _any_version(decoder: Any, payload: bytes) -> Any:
    try:
        return decoder.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError) as bad:
        raise messages.Malformed(str(bad)) from None


_run: Any = local_service.LocalService.run


def _run_but_stops(self: local_service.LocalService, raw: Any, context: Any) -> Any:
    return None if self.label == "peer.halt" else _run(self, raw, context)


def _run_stops_late(self: local_service.LocalService, raw: Any, context: Any) -> Any:
    if self.label == "peer.halt":
        time.sleep(6.0)
    return _run(self, raw, context)


_places = threading.Semaphore(20)  # fewer than may wait for a lock


def _run_in_line(self: local_service.LocalService, raw: Any, context: Any) -> Any:
    with _places if self.effect != "read" else contextlib.nullcontext():
        return _run(self, raw, context)


def _of_one_identity(self: resource.Resource, asking: set[str]) -> bool:
    movers = {session.partition("/")[0] for permit in self.calls.values() for session in permit.sessions}
    return not movers.isdisjoint(session.partition("/")[0] for session in asking)


_check_lock: Any = resource.Resource.check_lock


def _check_numbers(self: resource.Resource, tokens: Any, caller: str, session: str = "") -> None:
    _check_lock(self, [messages.Token(self.epoch, token.number) for token in tokens], caller, session)


_new_request: Any = client.new_request


def _as_long_as_usual(deadline_s: float | None) -> Any:
    request = _new_request(deadline_s)
    request.ignore_outer_deadline()
    return request


def _from_anybody(payload: bytes, identity: str) -> messages.EstopOrder:
    return msgspec.msgpack.decode(payload, type=messages.EstopOrder)


def _all_of(*breaks: Callable[[], None]) -> Callable[[], None]:
    def break_all() -> None:
        for one in breaks:
            one()

    return break_all


def _of_our_version(payload: bytes, identity: str) -> messages.EstopOrder:
    if msgspec.msgpack.decode(payload)[0] != messages.PROTOCOL:
        raise messages.Malformed("another version")
    return estop_messages.decode_estop_order(payload, identity)


_encode: Any = local_service.Signature.encode_result


def _nonsense(self: Any, label: str, result: Any) -> bytes:
    return b"\xc0" if label == "peer.angle" else _encode(self, label, result)


BREAK: dict[str, Callable[[], None]] = {
    "runs-late": _put(local_service.LocalService, "too_late", lambda self, expires_ns: False),
    "runs-twice": _put(active_calls.CallDeduplicator, "begin", _as_if_new),
    "forgets-the-latest": _put(active_calls.CallDeduplicator, "end", _end_in_64_bits),
    "ignores-locks": _put(resource.Resource, "check_lock", lambda self, tokens, caller, session="": None),
    "ignores-sessions": _all_of(
        _put(Deadman, "session_ended", lambda self, session: None),
        _put(Dispatcher, "session_ended", lambda self, session: None),
    ),
    "ignores-stops": _put(local_service.LocalService, "run", _run_but_stops),
    "stops-late": _put(local_service.LocalService, "run", _run_stops_late),
    "stops-in-line": _put(local_service.LocalService, "run", _run_in_line),
    "trusts-its-namesakes": _put(resource.Resource, "_is_of", _of_one_identity),
    "ignores-epochs": _put(resource.Resource, "check_lock", _check_numbers),
    "outlives-its-caller": _put(client, "new_request", _as_long_as_usual),
    "believes-any-estop": _put(broadcast, "decode_estop_order", _from_anybody),
    "hears-its-own-version-only": _all_of(  # and does not learn of it from the suite's own container either
        _put(broadcast, "decode_estop_order", _of_our_version),
        _put(latch.EstopLatch, "learn", lambda self, estops: None),
    ),
    "never-latches": _put(resource.Resource, "_is_of", lambda self, asking: True),
    "ignores-estops": _put(latch.EstopLatch, "take", _confirm_only),
    "forgets-estops": _put(store.EstopStore, "read", lambda self: []),
    "learns-no-estops": _put(latch.EstopLatch, "learn", lambda self, estops: None),
    "any-version": _put(messages, "decoded", _any_version),
    "ignores-cancels": _put(active_calls.ActiveCall, "cancel", lambda self: None),
    "endless-leases": _put(lock_table.LockTable, "expire", lambda self: None),
    "grants-what-moves": _put(lock_table.LockTable, "_running", lambda self, waiter: None),
    "answers-nonsense": _put(local_service.Signature, "encode_result", _nonsense),
    "sends-no-report": _put(Announcer, "beat", lambda self: None),
}
"""By name, what breaks it: called before the container begins."""
