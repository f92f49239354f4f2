"""Containers that break one rule each: what `trade conformance` has to notice."""

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec

from trade import (
    _container,
    _estop,
    _estop_line,
    _estop_messages,
    _estop_store,
    _local_service,
    _locks,
    _ongoing,
    _resources,
    _wire,
)
from trade._announcing import Announcer
from trade._deadman import Deadman
from trade._dispatch import Dispatcher


def _put(where: Any, name: str, instead: Any) -> Callable[[], None]:
    return lambda: setattr(where, name, instead)


def _as_if_new(self: _ongoing.Once, call: _wire.Call, ongoing: _ongoing.Ongoing) -> _ongoing.Ongoing:
    return ongoing


_end: Any = _ongoing.Once.end


def _end_in_64_bits(self: _ongoing.Once, ongoing: Any, call: _wire.Call, answer: Any, *, keep: bool) -> Any:
    wrapped = ((call.expires_ns or 0) + _ongoing.GRACE_NS + 2**63) % 2**64 - 2**63
    return _end(self, ongoing, msgspec.structs.replace(call, expires_ns=wrapped - _ongoing.GRACE_NS), answer, keep=keep)


def _confirm_only(self: _estop.Estops, order: _wire.EstopOrder, who: str) -> None:
    self._confirm(order.request, "")


def _any_version(decoder: Any, payload: bytes) -> Any:
    try:
        return decoder.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError) as bad:
        raise _wire.Malformed(str(bad)) from None


def _no_renewal(self: _locks.LockTable, numbers: Any, identity: str) -> list[int]:
    return list(numbers)


_run: Any = _local_service.LocalService.run


def _run_but_stops(self: _local_service.LocalService, raw: Any, context: Any) -> Any:
    return None if self.label == "peer.halt" else _run(self, raw, context)


def _run_stops_late(self: _local_service.LocalService, raw: Any, context: Any) -> Any:
    if self.label == "peer.halt":
        time.sleep(6.0)
    return _run(self, raw, context)


_places = threading.Semaphore(20)  # fewer than may wait for a lock


def _run_in_line(self: _local_service.LocalService, raw: Any, context: Any) -> Any:
    with _places if self.effect != "read" else contextlib.nullcontext():
        return _run(self, raw, context)


def _of_one_identity(self: _resources.Resource, asking: set[str]) -> bool:
    movers = {session.partition("/")[0] for permit in self.calls.values() for session in permit.sessions}
    return not movers.isdisjoint(session.partition("/")[0] for session in asking)


_check_lock: Any = _resources.Resource.check_lock


def _check_numbers(self: _resources.Resource, tokens: Any, caller: str, session: str = "") -> None:
    _check_lock(self, [_wire.Token(self.epoch, token.number) for token in tokens], caller, session)


_new_request: Any = _container.new_request


def _as_long_as_usual(deadline_s: float | None) -> Any:
    request = _new_request(deadline_s)
    request.ignore_outer_deadline()
    return request


def _from_anybody(payload: bytes, identity: str) -> _wire.EstopOrder:
    return msgspec.msgpack.decode(payload, type=_wire.EstopOrder)


def _all_of(*breaks: Callable[[], None]) -> Callable[[], None]:
    def break_all() -> None:
        for one in breaks:
            one()

    return break_all


def _of_our_version(payload: bytes, identity: str) -> _wire.EstopOrder:
    if msgspec.msgpack.decode(payload)[0] != _wire.PROTOCOL:
        raise _wire.Malformed("another version")
    return _estop_messages.decode_estop_order(payload, identity)


_encode: Any = _local_service.Signature.encode_result


def _nonsense(self: Any, label: str, result: Any) -> bytes:
    return b"\xc0" if label == "peer.angle" else _encode(self, label, result)


BREAK: dict[str, Callable[[], None]] = {
    "runs-late": _put(_local_service.LocalService, "too_late", lambda self, expires_ns: False),
    "runs-twice": _put(_ongoing.Once, "begin", _as_if_new),
    "forgets-the-latest": _put(_ongoing.Once, "end", _end_in_64_bits),
    "ignores-locks": _put(_resources.Resource, "check_lock", lambda self, tokens, caller, session="": None),
    "ignores-sessions": _all_of(
        _put(Deadman, "session_ended", lambda self, session: None),
        _put(Dispatcher, "session_ended", lambda self, session: None),
    ),
    "ignores-stops": _put(_local_service.LocalService, "run", _run_but_stops),
    "stops-late": _put(_local_service.LocalService, "run", _run_stops_late),
    "stops-in-line": _put(_local_service.LocalService, "run", _run_in_line),
    "trusts-its-namesakes": _put(_resources.Resource, "_is_of", _of_one_identity),
    "ignores-epochs": _put(_resources.Resource, "check_lock", _check_numbers),
    "outlives-its-caller": _put(_container, "new_request", _as_long_as_usual),
    "believes-any-estop": _put(_estop_line, "decode_estop_order", _from_anybody),
    "hears-its-own-version-only": _all_of(  # and does not learn of it from the suite's own container either
        _put(_estop_line, "decode_estop_order", _of_our_version),
        _put(_estop.Estops, "learn", lambda self, estops: None),
    ),
    "never-latches": _put(_resources.Resource, "_is_of", lambda self, asking: True),
    "ignores-estops": _put(_estop.Estops, "take", _confirm_only),
    "forgets-estops": _put(_estop_store.EstopStore, "read", lambda self: []),
    "learns-no-estops": _put(_estop.Estops, "learn", lambda self, estops: None),
    "any-version": _put(_wire, "decoded", _any_version),
    "ignores-cancels": _put(_ongoing.Ongoing, "cancel", lambda self: None),
    "endless-leases": _put(_locks.LockTable, "expire", lambda self: None),
    "grants-what-moves": _put(_locks.LockTable, "_running", lambda self, waiter: None),
    "answers-nonsense": _put(_local_service.Signature, "encode_result", _nonsense),
    "tells-no-tally": _put(Announcer, "beat", lambda self: None),
}
"""By name, what breaks it: called before the container begins."""
