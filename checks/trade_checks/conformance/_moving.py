"""Checks of motion: it stops on request, and with the client that started it."""

from trade import errors
from trade.protocol.messages import Status
from trade_checks.conformance._assertions import require
from trade_checks.conformance._check import check
from trade_checks.conformance._environment import Stage
from trade_checks.conformance._raw_client import NEVER, SYSTEM, RawClient, body_of, error_of


@check("turns", "Writing a container in another language")
def turns(stage: Stage) -> None:
    """A turn moves the arm, and is answered when the arm has arrived."""
    with stage.voice() as anna:
        goal_rad = stage.angle(anna) + (0.3 if stage.angle(anna) < 0 else -0.3)
        answer = anna.result(stage.peer.arm, "turn", goal_rad)
        require(answer == goal_rad and stage.angle(anna) == goal_rad, f"turn({goal_rad}) answered {answer}")


@check("stops", "S07")
def stops(stage: Stage) -> None:
    """halt stops the arm at once, and the turn ends with an error. It needs no expiry."""
    arm = stage.peer.arm
    with stage.voice() as anna:
        running = stage.begin_turn(anna)
        with stage.stopping(anna, "halt"):
            halting = anna.call(arm, "halt", stop=True, expires_ns=NEVER)
        require(anna.answer(halting).status == Status.OK, "halt was not answered with status 0")
        error_of(anna.answer(running))
        anna.result(arm, "turn", stage.angle(anna))  # a client's own stop does not latch


@check("stops-late", "S07")
def stops_late(stage: Stage) -> None:
    """A stop runs however late it is."""
    with stage.voice() as anna:
        stage.begin_turn(anna)
        with stage.stopping(anna, "a stop of an hour ago"):
            halting = anna.call(stage.peer.arm, "halt", stop=True, expires_ns=anna.expiry_ns(-3600.0))
        status = anna.answer(halting).status
        require(status == Status.OK, f"a stop of an hour ago was answered with status {status}")


@check("stop-latches", "S08")
def stop_latches(stage: Stage) -> None:
    """After a stop by another client nothing moves before resume; reading works."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        _latches(stage, anna, bob, "another client's stop")


@check("stop-latches-own", "S08")
def stop_latches_own(stage: Stage) -> None:
    """A stop by another session of the same identity latches too: it may be another person or program."""
    with stage.voice("anna") as anna, stage.voice("anna", client="2") as other:
        _latches(stage, anna, other, "a stop by another session of the same identity")


def _latches(stage: Stage, anna: RawClient, other: RawClient, stop: str) -> None:
    arm, running = stage.peer.arm, stage.begin_turn(anna)
    try:
        with stage.stopping(anna, stop):
            halting = other.call(arm, "halt", stop=True)
        body_of(other.answer(halting), "halt")
        error_of(anna.answer(running))
        began = stage.turns(anna)
        refused = error_of(anna.ask(arm, "turn", 0.1))
        require(isinstance(refused, errors.Stopped), f"a turn after {stop} ended with {refused!r}")
        require(stage.turns(anna) == began, f"a turn began after {stop}")
    finally:
        resumed = anna.result(SYSTEM, "resume", ["peer.arm"])
    require(list(resumed) == ["peer.arm"], f"resume answered {resumed!r}, not the resource that may move again")
    anna.result(arm, "turn", stage.angle(anna))


@check("session-ends", "S05")
def session_ends(stage: Stage) -> None:
    """When the session of a client ends, the motion that it started stops; another session's end stops nothing."""
    with stage.voice("anna") as anna:
        with stage.voice("bob") as bob, stage.voice("carol"):
            stage.begin_turn(bob)
            with stage.stopping(anna, "the end of the session that started it"):
                bob.close()
        running = stage.begin_turn(anna)
        with stage.voice("bob") as bob:
            stage.angle(bob)
        require(stage.moves(anna) and not anna.answers(running), "it stopped when another session ended")
        anna.cancel(running, "peer.turn")
        anna.answer(running)


@check("caller-ends", "S05")
def caller_ends(stage: Stage) -> None:
    """When the container of a caller ends, the motion that its clients started stops."""
    with stage.voice("anna") as anna, stage.voice("bob", client="") as bob:
        stage.begin_turn(bob)
        with stage.stopping(anna, "the end of the container that started it"):
            bob.close()


@check("behalf-ends", "S03")
def behalf_ends(stage: Stage) -> None:
    """A motion also stops when a session ends on whose behalf the call was made."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        stage.begin_turn(anna, sessions=[bob.session])
        with stage.stopping(anna, "the end of the session on whose behalf it moved"):
            bob.close()


@check("too-late-for-ended", "S05")
def too_late_for_ended(stage: Stage) -> None:
    """A call of a session that has ended does not begin."""
    with stage.voice("anna") as anna:
        bob = stage.voice("bob")
        bob.result(stage.peer.arm, "turn", stage.angle(anna))
        stage.begin_turn(bob)
        with stage.stopping(anna, "the end of the session that started it"):
            bob.close()
        began = stage.turns(anna)
        refused = error_of(anna.ask(stage.peer.arm, "turn", 0.1, sessions=[bob.session]))
        require(isinstance(refused, errors.SessionEnded), f"a turn for a session that has ended ended with {refused!r}")
        require(stage.turns(anna) == began, "a turn for a session that has ended began")
