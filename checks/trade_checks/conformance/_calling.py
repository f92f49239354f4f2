"""Checks of calls: their answers, which calls must not run, and that none runs twice."""

import math
import signal
import threading
from typing import Any, Final

from trade import errors
from trade.protocol.messages import CANCEL, Status
from trade_checks.conformance._assertions import eventually, require
from trade_checks.conformance._check import check
from trade_checks.conformance._environment import Stage
from trade_checks.conformance._raw_client import DEADLINE_S, NEVER, SYSTEM, error_of

_LATEST_NS: Final = 2**63 - 1


@check("answers", "Messages", still=True)
def answers(stage: Stage) -> None:
    """echo returns its argument, of every type, positional or named."""
    values: list[Any] = [None, True, -1, 2**63 - 1, -(2**63), 0.25, "häß", b"\x00\xff", [1, [2]], {"a": {"b": []}}]
    with stage.voice() as anna:
        for value in [*values, "x" * 70_000]:
            for how in ({}, {"by_name": {"value": value}}):
                args = () if how else (value,)
                answer = anna.result(stage.peer.place("echo"), "echo", *args, expires_ns=NEVER, **how)
                require(answer == value and type(answer) is type(value), f"echo({value!r}) answered {answer!r}"[:200])


@check("refuses-arguments", "Messages")
def refuses_arguments(stage: Stage) -> None:
    """Arguments that do not fit or exceed a limit are refused with a TRADE error, and the call does not run."""
    arm = stage.peer.arm
    with stage.voice() as anna:
        began = stage.turns(anna)
        unfit: list[tuple[Any, ...]] = [(), ("far",), (1.0, 2.0), (None,), ([],)]
        for args in unfit:
            found = error_of(anna.ask(arm, "turn", *args))
            require(isinstance(found, errors.InvalidArgument), f"turn{args} was refused with {found!r}")
        wrong = error_of(anna.ask(arm, "turn", by_name={"angle_deg": 1.0}))
        require(isinstance(wrong, errors.InvalidArgument), f"turn(angle_deg=...) was refused with {wrong!r}")
        for angle_rad in (math.nan, math.inf, -math.inf, 1e9):
            error_of(anna.ask(arm, "turn", angle_rad))
        require(stage.turns(anna) == began, "a turn with wrong arguments began")


@check("knows-not", "Messages")
def knows_not(stage: Stage) -> None:
    """An unknown service or provider is answered with status 4, as is a stop on a call's key, and the reverse."""
    arm = stage.peer.arm
    with stage.voice() as anna:
        began = stage.turns(anna)
        wrong: list[tuple[tuple[str, str], str, tuple[Any, ...], bool]] = [
            (arm, "fly", (), False),
            ((arm[0], "unknown"), "echo", (1,), False),
            (("elsewhere", arm[1]), "echo", (1,), False),
            (arm, "halt", (), False),
            (arm, "turn", (0.1,), True),
            (SYSTEM, "fly", (), True),
        ]
        for place, service, args, stop in wrong:
            reply = anna.ask(place, service, *args, stop=stop)
            where = f"{'/'.join(place)} {service} on a {'stop' if stop else 'call'} key"
            require(reply.status == Status.GONE, f"{where} was answered with status {reply.status}, not 4")
        require(stage.turns(anna) == began, "a turn that was sent as a stop began")


@check("late-is-never", "S01")
def late_is_never(stage: Stage) -> None:
    """A command without an expiry, or after it, is answered with status 3 and never runs."""
    arm = stage.peer.arm
    with stage.voice() as anna:
        began = stage.turns(anna)
        for expires_ns in (anna.expiry_ns(-0.001), anna.expiry_ns(-3600.0), 0, NEVER):
            reply = anna.ask(arm, "turn", 0.1, expires_ns=expires_ns)
            require(reply.status == Status.EXPIRED, f"a late turn was answered with status {reply.status}, not 3")
        require(stage.turns(anna) == began, "a turn began after its expiry")
        reply = anna.ask(SYSTEM, "acquire", ["peer.arm"], {}, expires_ns=NEVER)
        require(reply.status == Status.EXPIRED, f"a late acquire was answered with status {reply.status}, not 3")
        require(anna.ask(arm, "echo", 1, expires_ns=NEVER).status == Status.OK, "echo without an expiry did not run")


@check("late-when-frozen", "S01")
def late_when_frozen(stage: Stage) -> None:
    """A command that expires while the process is frozen never runs when the process continues."""
    peer, arm = stage.peer, stage.peer.arm
    with stage.voice() as anna:
        began, expires_ns = stage.turns(anna), anna.expiry_ns(0.5)
        peer.signal(signal.SIGSTOP)
        try:
            call_id = anna.call(arm, "turn", 0.1, expires_ns=expires_ns)
            threading.Event().wait(1.0)
        finally:
            peer.signal(signal.SIGCONT)
        require(anna.answer(call_id).status == Status.EXPIRED, "a turn that expired in a frozen process ran")
        require(stage.turns(anna) == began, "a turn that expired in a frozen process began")


@check("once", "S02")
def once(stage: Stage) -> None:
    """A repeated actuating call, while the first runs or later, gets the same answer and does not run again."""
    arm = stage.peer.arm
    with stage.voice() as anna:
        began, expires_ns = stage.turns(anna), anna.expiry_ns()
        goal_rad = stage.angle(anna) + (0.5 if stage.angle(anna) < 0 else -0.5)
        call_id = anna.call(arm, "turn", goal_rad, expires_ns=expires_ns)
        eventually(lambda: stage.turns(anna) > began, "a turn did not begin")
        anna.call(arm, "turn", goal_rad, call_id=call_id, expires_ns=expires_ns)
        eventually(lambda: len(anna.answers(call_id)) > 1, "the same call, sent again while it ran, has no answer")
        anna.call(arm, "turn", goal_rad, call_id=call_id, expires_ns=expires_ns)
        eventually(lambda: len(anna.answers(call_id)) > 2, "the same call, sent again later, has no answer")
        bodies = {(reply.status, bytes(reply.body)) for reply in anna.answers(call_id)}
        require(len(bodies) == 1, "the same call was answered differently")
        require(stage.turns(anna) == began + 1, f"one call began {stage.turns(anna) - began} turns")


@check("once-without-expiry", "S02")
def once_without_expiry(stage: Stage) -> None:
    """A call with the latest possible expiry is answered, does not run again, and does no harm."""
    peer, arm = stage.peer, stage.peer.arm
    with stage.voice() as anna:
        began, here_rad, call_id = stage.turns(anna), stage.angle(anna), anna.new_id()
        for times in (1, 2):
            anna.call(arm, "turn", here_rad, call_id=call_id, expires_ns=_LATEST_NS)
            sent = f"a call that never expires, sent {times} times, was not answered each time"
            eventually(lambda times=times: len(anna.answers(call_id)) >= times, sent)
            require(peer.alive, f"a call that never expires ended its process: {stage.last_words()}")
        statuses = [reply.status for reply in anna.answers(call_id)]
        require(statuses == [Status.OK] * 2, f"a call that never expires was answered with status {statuses}")
        require(stage.turns(anna) == began + 1, f"one call that never expires began {stage.turns(anna) - began} turns")


@check("once-for-each", "S02")
def once_for_each(stage: Stage) -> None:
    """Calls with the same id by two callers are two calls."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        began, call_id = stage.turns(anna), anna.new_id()
        here_rad = stage.angle(anna)
        for who in (anna, bob):
            who.result(stage.peer.arm, "turn", here_rad, call_id=call_id)
        require(stage.turns(anna) == began + 2, "a call of one caller was mistaken for that of another")


@check("cancels", "Once")
def cancels(stage: Stage) -> None:
    """A cancelled turn ends with an error and the arm rests; one cancelled before its arrival never begins."""
    arm = stage.peer.arm
    with stage.voice() as anna:
        running = stage.begin_turn(anna)
        with stage.stopping(anna, "its cancelling"):
            cancelling = anna.call(SYSTEM, CANCEL, running, "peer.turn", DEADLINE_S, stop=True)
        require(anna.answer(cancelling).status == Status.OK, "a cancel was not answered with status 0")
        error_of(anna.answer(running))
        began, unborn = stage.turns(anna), anna.new_id()
        require(anna.cancel(unborn, "peer.turn").status == Status.OK, "a cancel was not answered with status 0")
        found = error_of(anna.ask(arm, "turn", 0.1, call_id=unborn))
        require(isinstance(found, errors.Cancelled), f"a call cancelled before its arrival ended with {found!r}")
        require(stage.turns(anna) == began, "a turn cancelled before its arrival began")


@check("cancels-own-only", "Once")
def cancels_own_only(stage: Stage) -> None:
    """Only the caller of a call can cancel it."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        running = stage.begin_turn(anna)
        bob.cancel(running, "peer.turn")
        require(stage.moves(anna) and not anna.answers(running), "bob cancelled a call of anna")
        anna.cancel(running, "peer.turn")
        anna.answer(running)


@check("versions", "Versions")
def versions(stage: Stage) -> None:
    """A call of another version is dropped without an answer; one with additional fields is accepted."""
    arm = stage.peer.arm
    with stage.voice() as anna:
        began = stage.turns(anna)
        unread = [anna.call(arm, "turn", 0.1, version=version) for version in (0, 2, 255)]
        require(anna.ask(arm, "echo", 1, appended=[{"later": 1}, 2]).status == Status.OK, "a longer call did not run")
        require(stage.turns(anna) == began, "a turn of another version of the protocol began")
        require(not any(map(anna.answers, unread)), "a call of another version was answered")


@check("forged", "Keys")
def forged(stage: Stage) -> None:
    """A call that names another client's session, or that is sent to a key pattern, does not run."""
    peer, arm = stage.peer, stage.peer.arm
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        began = stage.turns(anna)
        here = f"{peer.address}/{'/'.join(arm)}"
        keys = (f"call/anna/{peer.address}/**", f"call/*/{here}", f"call/anna/{peer.address}/*/*")
        dropped = [anna.call(arm, "turn", 0.1, session=bob.session)]
        dropped += [anna.call(arm, "turn", 0.1, key=key) for key in keys]
        require(anna.ask(arm, "echo", 1).status == Status.OK, "echo did not run")
        require(stage.turns(anna) == began, "a forged turn began")
        statuses = [reply.status for call_id in dropped for reply in anna.answers(call_id)]
        require(Status.OK not in statuses, "a forged call was answered as if it had run")
