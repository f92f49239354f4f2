"""The part of a container that locks services, lets them move again, and stops everything."""

from collections.abc import Iterable, Sequence

from trade._calls.handle import Handle
from trade._container.base import Member
from trade._estop.broadcast import EstopReport
from trade._estop.controller import LIMIT_S
from trade._locks.api import LEASE_S, RESUME_WAIT_S, LockApi
from trade._locks.lock import Lock, OnLost, OnRequest
from trade._protocol.messages import Estop
from trade._registry.constraints import Constraint
from trade._resources.grants import LockInfo
from trade._stop_line import StopReport


class MotionControl(Member):
    """Who may use what, and who may not move at all."""

    locking: LockApi

    # --- locks

    def lock(
        self,
        which: Constraint | Iterable[Handle],
        *,
        purpose: str = "",
        wait_s: float = 10.0,
        lease_s: float = LEASE_S,
        priority: int = 0,
        delegates: Sequence[str] = (),
        partial: bool = False,
        on_lost: OnLost | None = None,
        on_request: OnRequest | None = None,
    ) -> Lock:
        """Services for oneself alone, on all their containers or on none: ``with container.lock(...):``.

        Nothing is taken before the context is entered (or `Lock.acquire` called).

        Args:
            which: the actuating services that match, as they are when it is taken, or handles. If nothing matches yet,
                it waits for that, and then for the whole of a robot's group. Of ``A | B`` it takes a part of each, or
                nothing. What such a constraint selects and the lock does not hold is not commanded under it.
            purpose: what for, as others are told who would like to have them.
            wait_s: how long to wait for others, and for what is not there yet, in seconds; 0 tries. Inside a call it
                ends before that call's deadline.
            lease_s: how long it outlives its owner, in seconds.
            priority: who waits with a higher one comes first.
            delegates: identities that may use it, too.
            partial: take a robot's group even if members of it are not there, and of ``A | B`` what there is; then
                `Lock.missing` says what is not.
            on_lost: called with the error, on a thread of its own, when it is lost.
            on_request: called with who and why, on a thread of its own, when somebody asks for it.

        Raises:
            NoSuchService: nothing matches within ``wait_s``.
            LockedByOther: somebody has one of them, or something still moves, after ``wait_s``.
            IncompleteGroup: the robot file says that more belongs to the group, or nothing of an alternative is there.
            ConfigurationError: there is nothing to lock in what matches: it only reads.
            AccessDenied: the policy does not let this container lock one of them.
            NotStopped: one of them could not be stopped when it had to be.
        """
        self._check_open()
        return self.locking.lock(
            which,
            purpose=purpose,
            wait_s=wait_s,
            lease_s=lease_s,
            priority=priority,
            delegates=delegates,
            partial=partial,
            on_lost=on_lost,
            on_request=on_request,
        )

    def locks(self) -> list[LockInfo]:
        """Every lock in the system: what, whose, what for, since when, who waits.

        Containers that do not answer within 2 s are left out, and named in the log.
        """
        self._check_open()
        return self.locking.locks()

    def request_release(self, which: Constraint | Iterable[Handle], reason: str) -> list[str]:
        """Ask the owners of locks on these services to give them back; they hear of who asks, and why.

        Returns:
            Who was asked.
        """
        self._check_open()
        return self.locking.request_release(which, reason)

    def break_lock(self, which: Constraint | Iterable[Handle], reason: str) -> list[LockInfo]:
        """Take the locks on these services away from their owners; what moves under them stops.

        Returns:
            Those that were broken.

        Raises:
            AccessDenied: the policy does not let this container administer one of them.
        """
        self._check_open()
        return self.locking.break_lock(which, reason)

    def resume(self, which: Constraint | Iterable[Handle], *, wait_s: float = RESUME_WAIT_S) -> list[str]:
        """Let services move again after a stop by somebody else.

        Args:
            which: handles, or a constraint: the actuating services that match.
            wait_s: how long to wait for what a constraint matches to be there, in seconds.

        Returns:
            The resources that were stopped.

        Raises:
            NoSuchService: nothing matches within ``wait_s`` seconds.
            LockedByOther: it is the owner of their lock who resumes.
            AccessDenied: without a lock of one's own it is for who administers them, says the policy.
        """
        self._check_open()
        return self.locking.resume(which, wait_s)

    # --- stops

    def stop(self, group: str, reason: str = "", *, limit_s: float = LIMIT_S) -> StopReport:
        """Stop all that moves in a group, and wait until it is at rest: every stop service there is, at once (S07).

        It needs no lock, and no link that stands already: containers are asked on the stop line, too, and what one of
        them stopped is stopped. Read the report: `StopReport.complete`. This is software, not safety-rated.

        Args:
            group: such as ``rosie.left``; all beneath it, too.
            reason: why, for the record.
            limit_s: how long to try, in seconds; also if nothing is found.

        Raises:
            ConfigurationError: that is no group, or no limit.
        """
        self._check_open()
        return self._parts.stop_all_of(group, reason, limit_s)

    # --- e-stops

    def estop(self, reason: str = "", *, limit_s: float = LIMIT_S, estop_id: str = "") -> EstopReport:
        """Stop everything in the whole system, and let nothing move until the e-stop is cleared (S09).

        It waits for nobody to be told, and is repeated until every container that has a stop service has confirmed
        that all of it is at rest. Read the report: `EstopReport.complete`. This is software, not safety-rated.

        Args:
            reason: why, for people.
            limit_s: how long to try, in seconds; also if nobody is found.
            estop_id: names it, in letters, digits, ``.``, ``_`` and ``-``; given again, it is the same e-stop. Empty: a
                new one.
        """
        self._check_open()
        return self._parts.estop.estop(reason, limit_s, estop_id)

    def estops(self) -> list[Estop]:
        """The e-stops that are open anywhere in the system, oldest first."""
        self._check_open()
        return self._parts.estop.open()

    def estop_clear(self, ids: Sequence[str], *, limit_s: float = LIMIT_S) -> EstopReport:
        """Clear e-stops by their ids; once none is open, calls are let through again. Nothing moves by itself.

        What somebody else's e-stop stopped while it was in use holds until `resume`, too (S08). A container that does
        not hear this, being away, keeps them open until they are cleared again.

        Args:
            ids: as `estops` tells them.
            limit_s: how long to try, in seconds.

        Raises:
            NoSuchEstop: an id that nobody knows as open; nothing is cleared then.
            AccessDenied: the policy does not let this container administer the system.
        """
        self._check_open()
        return self._parts.estop.clear(ids, limit_s)
