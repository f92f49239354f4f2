"""Checks of the e-stop: executed, confirmed, kept over a restart, adopted on joining, cleared."""

import secrets
import time
from collections.abc import Callable
from typing import Any

from trade import errors, where
from trade.protocol.estop_messages import decode_estop_confirmed
from trade.protocol.keys import estop_confirmed_key, estop_key
from trade.protocol.messages import PROTOCOL, Estop, EstopConfirmed, EstopOrder, Malformed, encode_message
from trade_checks.conformance._assertions import PATIENCE_S, eventually, require
from trade_checks.conformance._check import check
from trade_checks.conformance._environment import Stage
from trade_checks.conformance._peer import GROUP
from trade_checks.conformance._raw_client import NEVER, SYSTEM, RawClient, error_of

_CONFIRMED_WITHIN_S = 3.0
_WATCHED_S = 0.5


def _open(client: RawClient, reason: str = "a check") -> EstopOrder:
    name = secrets.token_hex(4)
    return EstopOrder(PROTOCOL, name, Estop(name, client.session, reason, time.time()))


def _cleared(*orders: EstopOrder) -> EstopOrder:
    return EstopOrder(PROTOCOL, secrets.token_hex(4), None, tuple(order.request for order in orders))


def _order(stage: Stage, client: RawClient, order: EstopOrder) -> EstopConfirmed:
    """Sends an order until it is confirmed; raises NotHeld if it is not."""
    return _confirmed(stage, client, order.request, encode_message(order))


def _confirmed(stage: Stage, client: RawClient, request: str, payload: bytes) -> EstopConfirmed:
    address = stage.peer.address
    with stage.listening(estop_confirmed_key(address)) as heard:
        found: list[EstopConfirmed] = []

        def confirmed() -> bool:
            client.put(estop_key(client.identity), payload, urgent=True)
            found[:] = [one for one in map(_confirmation, list(heard)) if one and one.request == request]
            return bool(found)

        eventually(confirmed, "an e-stop's order is not confirmed", PATIENCE_S)
        return found[0]


def _confirmation(message: Any) -> EstopConfirmed | None:
    try:
        return decode_estop_confirmed(message.payload or b"")
    except Malformed:
        return None


def _shown(stage: Stage) -> tuple[str, ...]:
    """The open e-stops in the container's own registry entry."""
    entries = stage.peer.offer().entries
    return tuple(estop.id for (domain, _), info in entries.items() if domain == SYSTEM[0] for estop in info.estops)


def _require_stopped(stage: Stage, client: RawClient, when: str) -> None:
    began = stage.turns(client)
    refused = error_of(client.ask(stage.peer.arm, "turn", 0.1))
    require(isinstance(refused, errors.Stopped) and refused.estop, f"a turn {when} ended with {refused!r}")
    require(stage.turns(client) == began, f"a turn began {when}")


@check("estop", "S09")
def estop(stage: Stage) -> None:
    """An e-stop stops everything and is shown and confirmed. Until it is cleared, reading works but nothing moves."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        running, order = stage.begin_turn(anna), _open(bob)
        try:
            since = time.monotonic()
            confirmed = _order(stage, bob, order)
            require(confirmed.problem == "", f"it reports that part of an e-stop failed: {confirmed.problem}")
            require(not stage.moves(anna), "the arm moves after the e-stop was confirmed")
            stage.require_rest(anna, "an e-stop", since)
            error_of(anna.answer(running))
            _require_stopped(stage, anna, "while an e-stop is open")
            require(order.request in _shown(stage), "its entry does not show the open e-stops")
            require(_order(stage, bob, order).problem == "", "a repeated order is not confirmed again")
            require(anna.ask(stage.peer.arm, "echo", 1, expires_ns=NEVER).status == 0, "an e-stop stopped reading")
        finally:
            cleared = _order(stage, bob, _cleared(order))
        require(cleared.problem == "", f"it reports that the clearing failed: {cleared.problem}")
        eventually(lambda: not _shown(stage), "its entry still shows a cleared e-stop")
        _order(stage, bob, order)
        require(not _shown(stage), "its own order opens a cleared e-stop again")
        anna.result(SYSTEM, "resume", ["peer.arm"])
        anna.result(stage.peer.arm, "turn", stage.angle(anna))


@check("estop-reported", "S09")
def estop_reported(stage: Stage) -> None:
    """An e-stop by a container of this project is reported as complete, and so is its clearing."""
    arm = stage.peer.place("turn")
    stage.container.find(where(name="halt", group=GROUP), wait_s=PATIENCE_S)
    report = stage.container.estop("a check", limit_s=_CONFIRMED_WITHIN_S)
    try:
        require(report.complete and "peer/peer" in report.confirmed, f"the report of an e-stop says {report}")
    finally:
        cleared = stage.container.estop_clear([report.id], limit_s=_CONFIRMED_WITHIN_S)
    require(cleared.complete, f"the report of the clearing says {cleared}")
    stage.container.resume(where(name="turn", group=GROUP))
    with stage.voice() as anna:
        anna.result(arm, "turn", stage.angle(anna))


@check("estop-forged", "E-stops")
def estop_forged(stage: Stage) -> None:
    """An order in the name of another identity is dropped: the arm continues."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        running, forged = stage.begin_turn(anna), _open(anna)
        bob.put(estop_key("bob"), encode_message(forged), urgent=True)
        until = time.monotonic() + _WATCHED_S
        while True:  # an effect may take a moment
            last = time.monotonic() >= until
            require(not _shown(stage), "a forged e-stop is open")
            require(stage.moves(anna) and not anna.answers(running), "a forged e-stop stopped the arm")
            if last:
                break
        anna.cancel(running, "peer.turn")
        anna.answer(running)


@check("estop-of-any-version", "S09")
def estop_of_any_version(stage: Stage) -> None:
    """An order to stop of another version is executed and confirmed, whatever its content; one to clear is not."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        running, order = stage.begin_turn(anna), _open(bob)
        try:
            later = [PROTOCOL + 1, order.request, [order.request, bob.session, {"text": "smoke"}, None, 7], "more"]
            confirmed = _confirmed(stage, bob, order.request, encode_message(later))
            require(confirmed.problem == "", f"it reports that part of an e-stop failed: {confirmed.problem}")
            require(not stage.moves(anna), "the arm moves after an e-stop of another version was confirmed")
            error_of(anna.answer(running))
            cleared = [PROTOCOL + 1, secrets.token_hex(4), None, [order.request]]
            for _ in range(3):
                bob.put(estop_key("bob"), encode_message(cleared), urgent=True)
            _require_stopped(stage, anna, "after a clearing of another version")
        finally:
            _order(stage, bob, _cleared(order))
        anna.result(SYSTEM, "resume", ["peer.arm"])
        anna.result(stage.peer.arm, "turn", stage.angle(anna))


@check("estop-kept", "S09")
def estop_kept(stage: Stage) -> None:
    """An e-stop is still open after a kill and a restart, even if other containers have cleared it meanwhile."""
    order = _with_voice(stage, lambda bob: _ordered(stage, bob))
    stage.kill()
    stage.container.estop_clear([order.request], limit_s=_CONFIRMED_WITHIN_S)
    with stage.voice("anna") as anna:  # this starts it
        try:
            require(order.request in _shown(stage), "after its restart the e-stop is not open any more")
            _require_stopped(stage, anna, "after a restart, with an e-stop open")
        finally:
            _order(stage, anna, _cleared(order))
        anna.result(stage.peer.arm, "turn", stage.angle(anna))


@check("estop-learnt", "S09")
def estop_learnt(stage: Stage) -> None:
    """A container that joins while an e-stop is open elsewhere adopts it."""
    order = _with_voice(stage, lambda bob: _ordered(stage, bob))
    stage.kill()
    stage.start(forgetful=True)
    with stage.voice("anna") as anna:
        try:
            eventually(lambda: order.request in _shown(stage), "it does not adopt an e-stop that is open elsewhere")
            _require_stopped(stage, anna, "with an e-stop open elsewhere")
        finally:
            _order(stage, anna, _cleared(order))
        eventually(lambda: not stage.container.estops(), "the e-stop is not cleared")
        anna.result(stage.peer.arm, "turn", stage.angle(anna))


def _ordered(stage: Stage, client: RawClient) -> EstopOrder:
    """Opens an e-stop in the container under test and the suite's own."""
    order = _open(client)
    _order(stage, client, order)

    def everywhere() -> bool:
        return any(one.id == order.request for one in stage.container._parts.estop.open_here())

    eventually(everywhere, "the suite's own container did not receive the e-stop")
    return order


def _with_voice(stage: Stage, does: Callable[[RawClient], EstopOrder]) -> EstopOrder:
    with stage.voice("bob") as bob:
        return does(bob)
