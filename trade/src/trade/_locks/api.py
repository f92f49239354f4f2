"""What one does with locks: take them over many services, look at them, ask for them, take them away; and resume."""

import contextlib
import logging
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple, Protocol

from trade._calls.handle import Handle
from trade._calls.run import Run
from trade._context.outgoing import Claim
from trade._locks.lease_client import LeaseClient
from trade._locks.lock import Lock, OnLost, OnRequest, Selection
from trade._protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey
from trade._registry.constraints import Constraint, Term, under
from trade._resources.grants import LockInfo, LockRequest
from trade._security.authorizer import Authorizer
from trade.errors import (
    Busy,
    ConfigurationError,
    DeadlineExceeded,
    IncompleteGroup,
    NoSuchService,
    OutcomeUnknown,
    TradeError,
)

_logger = logging.getLogger("trade")

LONGEST_WAIT_S: Final = 3600.0
LEASE_S: Final = 2.0
"""The lease of a lock is the deadman's budget, too (S12)."""
RESUME_WAIT_S: Final = 2.0
_SETTLE_S: Final = 1.0
_ANSWER_S: Final = 2.0
"""So long it may take to tell what is locked."""


class LockOverview(NamedTuple):
    """What is known of all locks."""

    locks: list[LockInfo]
    silent: list[Address]
    """Who is there and did not answer: what is locked in these is not known."""

    def still(self, container: str) -> bool:
        """Whether what was known of a container before is all that is known of it now."""
        return any(address.container == container for address in self.silent)


class LockHost(Protocol):
    """What locking asks of its container."""

    access: Final[Authorizer]

    @property
    def address(self) -> Address: ...
    def handle(self, key: ServiceKey) -> Handle: ...
    def services(self, constraint: Constraint | None = None) -> list[Handle]: ...
    def await_services(self, constraint: Constraint, ready: Callable[[], bool], wait_s: float) -> None: ...
    def addresses(self) -> list[Address]: ...


class LockApi:
    """The locks of one container; ``container.locking``."""

    def __init__(self, home: LockHost) -> None:
        self._home = home
        self.lease_client: Final = LeaseClient(home)

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
        if not 0 <= wait_s <= LONGEST_WAIT_S:
            raise ConfigurationError(where="lock", problem=f"wait_s must be 0 to {LONGEST_WAIT_S:g}, not {wait_s!r}")
        if not 0.1 <= lease_s <= 60:
            raise ConfigurationError(where="lock", problem=f"lease_s must be 0.1 to 60, not {lease_s!r}")
        terms = LockRequest(
            purpose=purpose, lease_s=lease_s, wait_s=wait_s, priority=priority, delegates=tuple(delegates)
        )

        def wanted() -> Selection:
            handles = self._there(which, wait_s, partial=partial)
            self._require("lock", handles, which)
            return Selection(resources_of(handles), tuple(absent(which, handles)))

        claim = Claim(which if isinstance(which, Constraint) else None)
        return Lock(self.lease_client, terms, wanted, on_lost, on_request, claim)

    def _there(self, which: Constraint | Iterable[Handle], wait_s: float, *, partial: bool) -> list[Handle]:
        """The services to lock. If nothing matches yet, that is waited for until it is there as a whole.

        A part of it is given a moment to become whole or to leave, as when a driver starts or ends.

        Raises:
            NoSuchService: nothing matches within ``wait_s`` seconds.
            ConfigurationError, IncompleteGroup: what matches cannot be locked.
        """

        def look() -> list[Handle]:
            handles = selected(which, self._home.services)
            if not partial:
                require_whole(which, handles)
            return handles

        if not isinstance(which, Constraint):
            return look()
        found: list[Handle] = []

        def arrived() -> bool:
            with contextlib.suppress(ConfigurationError, IncompleteGroup):  # it comes and goes one by one
                found[:] = look()
            return bool(found)

        def settled() -> bool:
            return arrived() or not self._home.services(which)

        try:
            self._home.await_services(which, settled, min(wait_s, _SETTLE_S))
            if not found:
                self._home.await_services(which, arrived, wait_s)
        except NoSuchService:
            if not self._home.services(which):
                raise
            return look()  # there is some of it, and it says what is missing
        return found

    def locks(self) -> list[LockInfo]:
        """Every lock in the system: what, whose, what for, since when, who waits.

        Containers that do not answer within 2 s are left out, and named in the log.
        """
        known = self.known()
        if known.silent:
            who = ", ".join(address.who for address in known.silent)
            _logger.warning("which locks there are in %s is not known: no answer within %g s", who, _ANSWER_S)
        return known.locks

    def known(self) -> LockOverview:
        """The locks of the system, and whose are not known."""
        runs: list[tuple[Address, Run]] = []
        found, silent = list[LockInfo](), list[Address]()
        for address in self._home.addresses():
            with contextlib.suppress(TradeError):  # it left meanwhile
                runs.append((address, self._service(address, "locks").with_(deadline_s=_ANSWER_S).start()))
        for address, run in runs:
            try:
                found.extend(run.result())
            except (Busy, DeadlineExceeded, OutcomeUnknown):
                silent.append(address)
            except TradeError:
                continue
        return LockOverview(sorted(found, key=lambda info: (info.resources, info.container)), silent)

    def request_release(self, which: Constraint | Iterable[Handle], reason: str) -> list[str]:
        """Ask the owners of locks on these services to give them back; they hear of who asks, and why.

        Returns:
            Who was asked.
        """
        return self._everywhere("request_release", which, reason)

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
        if not 0 <= wait_s <= LONGEST_WAIT_S:
            raise ConfigurationError(where="resume", problem=f"wait_s must be 0 to {LONGEST_WAIT_S:g}, not {wait_s!r}")
        if isinstance(which, Constraint):
            self._await_some(which, wait_s)
        return self._everywhere("resume", which)

    def _await_some(self, which: Constraint, wait_s: float) -> None:
        """Wait until some of it can be resumed, and a moment for the rest; what is missing then is left out.

        Raises:
            NoSuchService: nothing matches within ``wait_s`` seconds.
        """

        def found() -> list[Handle]:
            return [handle for handle in self._home.services(which) if handle.effect == "actuate"]

        def whole() -> bool:
            with contextlib.suppress(IncompleteGroup):
                require_whole(which, found())
                return True
            return False

        try:
            self._home.await_services(which, lambda: bool(found()), wait_s)
        except NoSuchService:
            if not self._home.services(which):
                raise
            return  # what matches does not actuate, and that is said next
        with contextlib.suppress(NoSuchService):
            self._home.await_services(which, whole, min(wait_s, _SETTLE_S))

    def break_lock(self, which: Constraint | Iterable[Handle], reason: str) -> list[LockInfo]:
        """Take the locks on these services away from their owners; what moves under them stops.

        Returns:
            Those that were broken.

        Raises:
            AccessDenied: the policy does not let this container administer one of them.
        """
        handles = selected(which, self._home.services)
        self._require("administer", handles, which)
        wanted = resources_of(handles)
        broken: list[LockInfo] = []
        for address, names in wanted.items():
            hit = [info for info in self._service(address, "locks")() if not set(names).isdisjoint(info.resources)]
            broken += [info for info in hit if self._service(address, "break_lock")(info.token.number, reason)]
        return broken

    def _require(self, verb: str, handles: Sequence[Handle], which: Constraint | Iterable[Handle]) -> None:
        """Raises AccessDenied, which names what was asked for, and then the service that it fails at."""
        groups = _groups_of(which) if isinstance(which, Constraint) else []
        for handle in handles:
            what = f"{groups[0]} (of it {handle.label})" if len(groups) == 1 else handle.label
            self._home.access.require(self._home.address.identity, verb, handle.key.domain, what)

    def _everywhere(self, name: str, which: Constraint | Iterable[Handle], *rest: str) -> list[str]:
        verb = "resume" if name == "resume" else "lock"
        wanted = resources_of(selected(which, self._home.services, verb))
        runs = [self._service(address, name).start(names, *rest) for address, names in wanted.items()]
        return [text for run in runs for text in run.result()]

    def _service(self, address: Address, name: str) -> Handle:
        return self._home.handle(ServiceKey(address, DOMAIN, PROVIDER, name))


def resources_of(handles: Sequence[Handle]) -> dict[Address, list[str]]:
    """What to lock for the use of services, by the container that judges it."""
    wanted: dict[Address, dict[str, None]] = {}
    for handle in handles:
        wanted.setdefault(handle.key.address, {}).update(dict.fromkeys(handle.record.used))
    return {address: list(names) for address, names in wanted.items()}


def selected(
    which: Constraint | Iterable[Handle], select: Callable[[Constraint], Sequence[Handle]], verb: str = "lock"
) -> list[Handle]:
    """The services a lock, or a resume, is for: those given, or the actuating ones that match.

    Raises:
        ConfigurationError: there are none, a stop is among them, or it is one handle and no list.
    """
    if isinstance(which, Handle):
        problem = f"is one service; give a list, {verb}([handle]), or a constraint, {verb}(where(...))"
        raise ConfigurationError(where=which.label, problem=problem)
    if isinstance(which, Constraint):
        found = [handle for handle in select(which) if handle.effect == "actuate"]
        if not found:
            problem = f"nothing that matches actuates, so there is nothing to {verb}"
            problem += "; what reads is locked by its handle" if verb == "lock" else ""
            raise ConfigurationError(where=f"{verb} of {which}", problem=problem)
        return found
    found = list(which)
    if noted := next((handle for handle in found if handle.effect == "note"), None):
        problem = "it only writes something down; no lock takes it"
        raise ConfigurationError(where=noted.label, problem=problem)
    if not found:
        raise ConfigurationError(where=verb, problem=f"an empty selection {verb}s nothing; name some services")
    for handle in found:
        if handle.effect == "stop":
            raise ConfigurationError(where=handle.label, problem="a stop is everybody's; it cannot be locked")
    return found


def _groups_of(which: Constraint) -> list[str]:
    """The groups that a constraint names."""
    return [term.pattern for clause in which.clauses for term in clause if term.field == "group" and not term.negated]


def require_whole(which: Constraint | Iterable[Handle], handles: Sequence[Handle]) -> None:
    """A group of a robot is locked as a whole (S16), and of a union a part of each alternative (S13).

    Raises:
        IncompleteGroup: some of what belongs to it is not there.
    """
    if missing := absent(which, handles):
        groups = _groups_of(which) if isinstance(which, Constraint) else []
        raise IncompleteGroup(group=groups[0] if len(groups) == 1 else str(which), missing=missing)


def absent(which: Constraint | Iterable[Handle], handles: Sequence[Handle]) -> list[str]:
    """What a constraint is for and is not among these: members that the robot file names, and whole alternatives."""
    if not isinstance(which, Constraint):
        return []
    groups, there = _groups_of(which), {name for handle in handles for name in handle.record.info.uses}
    expected = {
        member
        for handle in handles
        for whole, members in handle.record.members.items()
        if any(under(whole, group) for group in groups)
        for member in members
    }
    alternatives = [one for one in _alternatives(which) if not any(one.matches(handle.record) for handle in handles)]
    return sorted(expected - there) + [str(one) for one in alternatives]


def _alternatives(which: Constraint) -> list[Constraint]:
    """What is asked for in place of each other; clauses that differ in what they leave out are one."""
    asked: dict[frozenset[Term], list[frozenset[Term]]] = {}
    for clause in which.clauses:
        asked.setdefault(frozenset(term for term in clause if not term.negated), []).append(clause)
    return [Constraint(tuple(clauses)) for clauses in asked.values()]
