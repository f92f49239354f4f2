"""Checks of locks: exclusive use under a lease, and a stop when the lock is lost."""

import threading
import time

import msgspec

from trade import LockInfo, errors, where
from trade.protocol.messages import Status, Token
from trade_checks.conformance._assertions import PATIENCE_S, NotHeld, eventually, require
from trade_checks.conformance._check import check
from trade_checks.conformance._environment import Stage
from trade_checks.conformance._peer import GROUP
from trade_checks.conformance._raw_client import SYSTEM, RawClient, body_of, error_of

_ARM = ["peer.arm"]
_LEASE_S = 1.0
_MANY = 100


def _renew(client: RawClient, lock: Token) -> dict[int, str]:
    return dict(client.result(SYSTEM, "renew", [lock.number], stop=True))


def _release(client: RawClient, lock: Token, lost: str = "") -> bool:
    return bool(client.result(SYSTEM, "release", lock.number, lost, stop=True))


def _locks_of(client: RawClient) -> list[LockInfo]:
    try:
        return msgspec.convert(client.result(SYSTEM, "locks"), list[LockInfo])
    except msgspec.ValidationError as bad:
        raise NotHeld(f"the answer of locks cannot be read: {bad}") from None


@check("locks", "S11")
def locks(stage: Stage) -> None:
    """Under a lock only calls that show it run; reading works; after its release, the resource is free."""
    arm, here = stage.peer.arm, stage.peer.address
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        lock = stage.granted(anna, _ARM, purpose="a check", lease_s=20.0)
        require(lock.epoch == here.epoch, f"the token's epoch is {lock.epoch}, not that of the container")
        began, here_rad = stage.turns(anna), stage.angle(anna)
        elsewhere = Token("0" * len(here.epoch), lock.number)  # a number alone is no proof
        unknown = Token(here.epoch, lock.number + 1)
        for who, tokens in ((bob, ()), (anna, ()), (bob, (lock,)), (bob, (unknown,)), (anna, (elsewhere,))):
            refused = error_of(who.ask(arm, "turn", here_rad, tokens=tokens))
            require(
                isinstance(refused, (errors.LockedByOther, errors.LockLost)), f"a turn without the lock: {refused!r}"
            )
        require(stage.turns(anna) == began, "a turn began without the lock")
        anna.result(arm, "turn", here_rad, tokens=[lock])
        require(stage.turns(anna) == began + 1, "the turn under the lock did not begin")
        require(_release(anna, lock), "the lock was not released")
        bob.result(arm, "turn", here_rad)


@check("locks-shown", "S11")
def locks_shown(stage: Stage) -> None:
    """locks shows what is held, by which owner and for what purpose; a refusal names the owner."""
    arm = stage.peer.arm
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        lock = stage.granted(anna, _ARM, purpose="a check", lease_s=20.0)
        found = _locks_of(bob)
        require(len(found) == 1, f"locks answered {found!r}")
        [info] = found
        require(info.token == lock, "locks shows a token other than the granted one")
        require(list(info.resources) == _ARM, f"locks shows the resources {info.resources!r}")
        shown = (info.holder.identity, info.holder.session, info.holder.purpose)
        require(shown == ("anna", anna.session, "a check"), f"locks shows the holder {info.holder!r}")
        require(0 < info.left_s <= 20, f"locks shows that {info.left_s!r} s of a lease of 20 s are left")
        refused = error_of(bob.ask(arm, "turn", 0.1))
        require(isinstance(refused, errors.LockedByOther), f"a turn without the lock ended with {refused!r}")
        require("anna" in str(refused) and "a check" in str(refused), f"the refusal lacks owner or purpose: {refused}")
        _release(anna, lock)


@check("locked-by-suite", "S11")
def locked_by_suite(stage: Stage) -> None:
    """A container of this project locks its group as a whole, keeps the lock and turns the arm under it."""
    suite = stage.container
    turn = suite.find(where(name="turn", group=GROUP), wait_s=PATIENCE_S)
    with stage.voice() as anna:
        here_rad = stage.angle(anna)
        with suite.lock(where(group=GROUP), purpose="a check", lease_s=_LEASE_S) as lock:
            require("peer.arm" in lock.resources, f"what was locked is {lock.resources}")
            threading.Event().wait(2 * _LEASE_S)
            require(turn(here_rad) == here_rad, "turn answered something else")
            require([info.token for info in suite.locks()] == list(lock.tokens()), f"the locks are {suite.locks()}")
            refused = error_of(anna.ask(stage.peer.arm, "turn", here_rad))
            require(isinstance(refused, errors.LockedByOther), f"a turn without the lock ended with {refused!r}")
        anna.result(stage.peer.arm, "turn", here_rad)


@check("one-owner", "S13")
def one_owner(stage: Stage) -> None:
    """A second client is refused at once, or waits as long as it requests; only its owner releases a lock."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        lock = stage.granted(anna, _ARM, lease_s=20.0)
        refused = error_of(stage.acquire(bob, _ARM))
        require(isinstance(refused, errors.LockedByOther), f"acquire of a locked resource ended with {refused!r}")
        require(not _release(bob, lock), "bob released the lock of anna")
        require(_renew(bob, lock), "bob renewed the lock of anna")
        waiting = bob.call(SYSTEM, "acquire", _ARM, {"wait_s": 6.0, "lease_s": 20.0})
        threading.Event().wait(0.2)
        require(not bob.answers(waiting), "acquire did not wait for its turn")
        _release(anna, lock)
        reply = bob.answer(waiting)
        require(reply.status == Status.OK, f"acquire that waited for its turn was answered with status {reply.status}")
        for info in _locks_of(bob):
            _release(bob, info.token)
        unknown = error_of(stage.acquire(bob, ["peer.nothing"]))
        require(isinstance(unknown, errors.ServiceGone), f"acquire of an unknown resource ended with {unknown!r}")


@check("waits-for-motion", "S13")
def waits_for_motion(stage: Stage) -> None:
    """A moving resource is granted only after it rests; while a client waits for that, no new call begins."""
    arm = stage.peer.arm
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        running = stage.begin_turn(anna)
        refused = error_of(stage.acquire(bob, _ARM))
        require(isinstance(refused, errors.LockedByOther), f"acquire of a moving resource ended with {refused!r}")
        waiting = bob.call(SYSTEM, "acquire", _ARM, {"wait_s": 7.0, "lease_s": 20.0})
        threading.Event().wait(0.2)
        began = stage.turns(anna)
        shut_out = error_of(anna.ask(arm, "turn", 0.1))
        require(isinstance(shut_out, errors.LockedByOther), f"a turn while a client waits for a lock: {shut_out!r}")
        require(stage.turns(anna) == began, "a turn began while a client waited for a lock")
        require(not bob.answers(waiting), "a moving resource was granted")
        anna.cancel(running, "peer.turn")
        reply = bob.answer(waiting)
        require(reply.status == Status.OK, f"acquire of a resource at rest was answered with status {reply.status}")
        for info in _locks_of(bob):
            _release(bob, info.token)


@check("leases", "S12")
def leases(stage: Stage) -> None:
    """A lock lasts while it is renewed and expires with its lease; its motion stops; it never comes back."""
    arm = stage.peer.arm
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        lock = stage.granted(anna, _ARM, lease_s=_LEASE_S * 2)
        for _ in range(8):  # longer than the lease
            threading.Event().wait(_LEASE_S / 2)
            require(not _renew(anna, lock), "renew reports a renewed lock as lost")
        running = stage.begin_turn(anna, tokens=[lock])
        require(not _renew(anna, lock), "renew reports a renewed lock as lost")
        over = time.monotonic() + _LEASE_S * 2  # not later: the renewal was answered
        stage.require_rest(anna, "the lease of the lock it moved under ended", over)
        eventually(lambda: not _locks_of(bob), "a lock that was not renewed still holds")
        error_of(anna.answer(running))
        require(lock.number in _renew(anna, lock), "renew does not report an expired lock")
        refused = error_of(anna.ask(arm, "turn", 0.1, tokens=[lock]))
        require(isinstance(refused, errors.LockLost), f"a turn under an expired lock ended with {refused!r}")
        bob.result(arm, "turn", stage.angle(bob))


@check("stop-beside-waiting", "S07")
def stop_beside_waiting(stage: Stage) -> None:
    """A stop runs in time while a hundred calls wait for a lock; they end with their session."""
    with stage.voice("anna") as anna:
        lock = stage.granted(anna, _ARM, lease_s=30.0)
        running = stage.begin_turn(anna, tokens=[lock])
        with stage.voice("bob") as bob:
            asked = [bob.call(SYSTEM, "acquire", _ARM, {"wait_s": 7.0}) for _ in range(_MANY)]
            eventually(
                lambda: _waiting(anna) + sum(bool(bob.answers(one)) for one in asked) >= _MANY, "some did not arrive"
            )
            require(_waiting(anna), "no client waits for a lock that is held")
            with stage.stopping(anna, "a stop, while many wait for a lock"):
                halting = anna.call(stage.peer.arm, "halt", stop=True)
            body_of(anna.answer(halting), "halt")
            error_of(anna.answer(running))
        eventually(lambda: not _waiting(anna), "an ended client still waits for a lock")
        require(_release(anna, lock), "the lock was not released")
        anna.result(stage.peer.arm, "turn", stage.angle(anna))


def _waiting(client: RawClient) -> int:
    return sum(len(info.waiting) for info in _locks_of(client))


@check("owner-ends", "S12")
def owner_ends(stage: Stage) -> None:
    """The end of a session releases its lock."""
    with stage.voice("bob") as bob:
        with stage.voice("anna") as anna:
            stage.granted(anna, _ARM, lease_s=30.0)
        eventually(lambda: not _locks_of(bob), "the lock of a session that has ended still holds")
        bob.result(stage.peer.arm, "turn", stage.angle(bob))


@check("lost-stops", "S14")
def lost_stops(stage: Stage) -> None:
    """Motion under a lock stops when the lock is broken, or released as lost."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        for how in ("broken", "lost"):
            lock = stage.granted(anna, _ARM, lease_s=30.0)
            stage.begin_turn(anna, tokens=[lock])
            with stage.stopping(anna, f"the lock it moved under was {how}"):
                if how == "broken":
                    asked = bob.call(SYSTEM, "break_lock", lock.number, "a check", stop=True)
                else:
                    asked = anna.call(SYSTEM, "release", lock.number, "a part of it is gone", stop=True)
            answer = (bob if how == "broken" else anna).answer(asked)
            require(body_of(answer, "its end"), f"the lock was not {how}")
            refused = error_of(anna.ask(stage.peer.arm, "turn", 0.1, tokens=[lock]))
            require(isinstance(refused, errors.LockLost), f"a turn under a lock that was {how} ended with {refused!r}")


@check("stop-needs-no-lock", "S07")
def stop_needs_no_lock(stage: Stage) -> None:
    """A stop runs although another client has the lock."""
    with stage.voice("anna") as anna, stage.voice("bob") as bob:
        lock = stage.granted(anna, _ARM, lease_s=30.0)
        stage.begin_turn(anna, tokens=[lock])
        try:
            with stage.stopping(anna, "a stop by a client without the lock"):
                halting = bob.call(stage.peer.arm, "halt", stop=True)
            body_of(bob.answer(halting), "halt")
            refused = error_of(bob.ask(SYSTEM, "resume", _ARM))
            require(isinstance(refused, errors.LockedByOther), f"resume without the lock ended with {refused!r}")
        finally:
            anna.result(SYSTEM, "resume", _ARM)
            _release(anna, lock)
