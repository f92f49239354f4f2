"""The lock methods of a container: take, list, request and break locks, and resume after stops."""

import contextlib
import logging
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._calls.run import Run
from trade._context.outgoing import Claim
from trade._locks.lease_client import LeaseClient
from trade._locks.lock import Lock, OnLost, OnRequest, Selection
from trade._registry.constraints import Constraint, Term, as_constraint, group_at, under
from trade._resources.grants import LockInfo, LockRequest
from trade._table import Table
from trade._threads.scheduler import Scheduler
from trade.errors import (
    Busy,
    ConfigurationError,
    DeadlineExceeded,
    IncompleteGroup,
    NoSuchService,
    OutcomeUnknown,
    TradeError,
)
from trade.protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey

_logger = logging.getLogger("trade")

LONGEST_WAIT_S: Final = 3600.0
LEASE_S: Final = 2.0
"""The default lease of a lock, which is also the time limit of the deadman (S12)."""
RESUME_WAIT_S: Final = 2.0
_SETTLE_S: Final = 1.0
_COLUMNS: Final = {
    "LOCKED": "resources",
    "OWNER": "holder.owner",
    "PURPOSE": "holder.purpose",
    "LEFT (s)": "left_s",
    "WAITING": "waiting",
}
_ANSWER_S: Final = 2.0
"""How long a container may take to list its locks."""


class LockOverview(NamedTuple):
    """The known locks of all containers."""

    locks: list[LockInfo]
    silent: list[Address]
    """Containers that did not answer: their locks are not known."""

    def still(self, container: str) -> bool:
        """Whether a container did not answer, so that only its earlier locks are known."""
        return any(address.container == container for address in self.silent)


class LockApi:
    """The lock methods of one container; ``container.lock_api``."""

    def __init__(self, client: CallClient, timers: Scheduler) -> None:
        self._client = client
        self.lease_client: Final = LeaseClient(client, timers)

    def lock(
        self,
        which: Constraint | str | Iterable[Handle],
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
        """Locks services for exclusive use, in all their containers or in none: ``with container.lock(...):``.

        It acquires nothing before the context is entered or `Lock.acquire` is called.

        Args:
            which: handles; or a constraint or a group as text, for the actuating services that match when the lock is
                acquired. If nothing matches yet, the lock waits for a match, and then for the whole of a robot's group.
                Of ``A | B`` it takes a part of each, or nothing. Under the lock, a service that such a constraint
                selects but the lock does not hold cannot be commanded.
            purpose: the reason, as other clients see it.
            wait_s: how long to wait for other clients and missing services, in seconds; 0 does not wait. Inside a call
                the wait ends before that call's deadline.
            lease_s: how long the lock outlives its owner, in seconds.
            priority: waiting clients with a higher one come first.
            delegates: identities that may use the lock, too.
            partial: take a robot's group although members are missing, and of ``A | B`` the available parts;
                `Lock.missing` then lists the others.
            on_lost: called with the error, on another thread, when the lock is lost.
            on_request: called with the client and its reason, on another thread, when a client requests its release.

        Raises:
            NoSuchService: nothing matches within ``wait_s``.
            LockedByOther: after ``wait_s``, another client still holds one of them, or something still moves.
            IncompleteGroup: members of the group in the robot file, or a whole alternative, are missing.
            ConfigurationError: the matching services only read, so there is nothing to lock.
            AccessDenied: the policy does not let this container lock one of them.
            NotStopped: a required stop of one of them failed.
        """
        if not 0 <= wait_s <= LONGEST_WAIT_S:
            raise ConfigurationError(where="lock", problem=f"wait_s must be 0 to {LONGEST_WAIT_S:g}, not {wait_s!r}")
        if not 0.1 <= lease_s <= 60:
            raise ConfigurationError(where="lock", problem=f"lease_s must be 0.1 to 60, not {lease_s!r}")
        terms = LockRequest(
            purpose=purpose, lease_s=lease_s, wait_s=wait_s, priority=priority, delegates=tuple(delegates)
        )

        meant = _meant(which, "lock")

        def wanted() -> Selection:
            handles = self._there(meant, wait_s, partial=partial)
            self._require("lock", handles, meant)
            return Selection(resources_of(handles), tuple(absent(meant, handles)))

        claim = Claim(meant if isinstance(meant, Constraint) else None)
        return Lock(self.lease_client, terms, wanted, on_lost, on_request, claim, _text(meant))

    def _there(self, which: Constraint | Iterable[Handle], wait_s: float, *, partial: bool) -> list[Handle]:
        """The services to lock. If nothing matches yet, it waits until the whole selection exists.

        An incomplete selection gets a moment to become complete or to disappear, as when a driver starts or ends.

        Raises:
            NoSuchService: nothing matches within ``wait_s`` seconds.
            ConfigurationError, IncompleteGroup: what matches cannot be locked.
        """

        def look() -> list[Handle]:
            handles = selected(which, self._client.services)
            if not partial:
                require_whole(which, handles)
            return handles

        if not isinstance(which, Constraint):
            return look()
        found: list[Handle] = []

        def arrived() -> bool:
            with contextlib.suppress(ConfigurationError, IncompleteGroup):  # services come and go one by one
                found[:] = look()
            return bool(found)

        def settled() -> bool:
            return arrived() or not self._client.services(which)

        try:
            self._client.await_services(which, settled, min(wait_s, _SETTLE_S))
            if not found:
                self._client.await_services(which, arrived, wait_s)
        except NoSuchService:
            if not self._client.services(which):
                raise
            return look()  # a part of it exists, and the error names the missing ones
        return found

    def locks(self) -> Table[LockInfo]:
        """Every lock in the system, with its resources, owner, purpose, start and waiters.

        Containers that do not answer within 2 s are omitted, and named in the log.
        """
        known = self.known()
        if known.silent:
            who = ", ".join(address.who for address in known.silent)
            _logger.warning("the locks in %s are not known: no answer within %g s", who, _ANSWER_S)
        return Table(known.locks, _COLUMNS)

    def known(self) -> LockOverview:
        """The known locks of the system, and the containers that did not answer."""
        runs: list[tuple[Address, Run]] = []
        present = self._client.everywhere("locks")
        found, silent = list[LockInfo](), list(present.silent)
        for handle in present.handles:
            with contextlib.suppress(TradeError):  # it left meanwhile
                runs.append((handle.key.address, handle.with_(deadline_s=_ANSWER_S).start()))
        for address, run in runs:
            try:
                found.extend(run.result())
            except (Busy, DeadlineExceeded, OutcomeUnknown):
                silent.append(address)
            except TradeError:
                continue
        return LockOverview(sorted(found, key=lambda info: (info.resources, info.container)), silent)

    def request_release(self, which: Constraint | str | Iterable[Handle], reason: str) -> list[str]:
        """Asks the owners of locks on these services to release them; they learn which client asks, and why.

        Returns:
            The owners.
        """
        return self._everywhere("request_release", _meant(which, "request_release"), reason)

    def resume(self, which: Constraint | str | Iterable[Handle], *, wait_s: float = RESUME_WAIT_S) -> list[str]:
        """Lets services move again after a stop by another client.

        Args:
            which: handles, or a constraint or a group as text: the actuating services that match.
            wait_s: how long to wait for services that match the constraint, in seconds.

        Returns:
            The resources that were stopped.

        Raises:
            NoSuchService: nothing matches within ``wait_s`` seconds.
            LockedByOther: another client holds their lock; only that client may resume them.
            AccessDenied: this container has no lock on them, and the policy does not let it administer them.
        """
        if not 0 <= wait_s <= LONGEST_WAIT_S:
            raise ConfigurationError(where="resume", problem=f"wait_s must be 0 to {LONGEST_WAIT_S:g}, not {wait_s!r}")
        meant = _meant(which, "resume")
        if isinstance(meant, Constraint):
            self._await_some(meant, wait_s)
        return self._everywhere("resume", meant)

    def _await_some(self, which: Constraint, wait_s: float) -> None:
        """Waits until a service can be resumed, and a moment for the others; later ones are omitted.

        Raises:
            NoSuchService: nothing matches within ``wait_s`` seconds.
        """

        def found() -> list[Handle]:
            return [handle for handle in self._client.services(which) if handle.effect == "actuate"]

        def whole() -> bool:
            with contextlib.suppress(IncompleteGroup):
                require_whole(which, found())
                return True
            return False

        try:
            self._client.await_services(which, lambda: bool(found()), wait_s)
        except NoSuchService:
            if not self._client.services(which):
                raise
            return  # the matching services do not actuate; the next step raises that error
        with contextlib.suppress(NoSuchService):
            self._client.await_services(which, whole, min(wait_s, _SETTLE_S))

    def break_lock(self, which: Constraint | str | Iterable[Handle], reason: str) -> list[LockInfo]:
        """Takes the locks on these services away from their owners; motion under them stops.

        Returns:
            The broken locks.

        Raises:
            AccessDenied: the policy does not let this container administer one of them.
        """
        meant = _meant(which, "break_lock")
        handles = selected(meant, self._client.services)
        self._require("administer", handles, meant)
        wanted = resources_of(handles)
        broken: list[LockInfo] = []
        for address, names in wanted.items():
            hit = [info for info in self._service(address, "locks")() if not set(names).isdisjoint(info.resources)]
            broken += [info for info in hit if self._service(address, "break_lock")(info.token.number, reason)]
        return broken

    def _require(self, verb: str, handles: Sequence[Handle], which: Constraint | Iterable[Handle]) -> None:
        """Raises AccessDenied, which names the requested group and the forbidden service."""
        groups = _groups_of(which) if isinstance(which, Constraint) else []
        for handle in handles:
            what = f"{groups[0]} (of it {handle.label})" if len(groups) == 1 else handle.label
            self._client.access.require(self._client.address.identity, verb, handle.key.domain, what)

    def _everywhere(self, name: str, which: Constraint | Iterable[Handle], *rest: str) -> list[str]:
        verb = "resume" if name == "resume" else "lock"
        wanted = resources_of(selected(which, self._client.services, verb))
        runs = [self._service(address, name).start(names, *rest) for address, names in wanted.items()]
        return [text for run in runs for text in run.result()]

    def _service(self, address: Address, name: str) -> Handle:
        return self._client.handle(ServiceKey(address, DOMAIN, PROVIDER, name))


def _meant(which: Constraint | str | Iterable[Handle], function: str) -> Constraint | list[Handle]:
    """The selection of a caller: a group as text is a constraint. Raises ConfigurationError for anything else."""
    if isinstance(which, Handle):
        problem = f"is one service; give a list, {function}([handle]), or its group, {function}({which.key.domain!r})"
        raise ConfigurationError(where=which.label, problem=problem)
    if isinstance(which, Constraint | str) or not isinstance(which, Iterable):  # pyright: ignore[reportUnnecessaryIsInstance]
        return as_constraint(which, f"trade.{function}", group_at)
    handles = list(which)
    if wrong := next((one for one in handles if not isinstance(one, Handle)), None):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ConfigurationError(where=f"trade.{function}", problem=f"the list must have handles only, not {wrong!r}")
    return handles


def _text(which: Constraint | list[Handle]) -> str:
    """A selection in the words of a caller."""
    if isinstance(which, Constraint):
        text = str(which)
        group = text.removeprefix("group='").removesuffix("'")
        return group if text == f"group={group!r}" else text
    return ", ".join(handle.label for handle in which)


def resources_of(handles: Sequence[Handle]) -> dict[Address, list[str]]:
    """The resources to lock for services, by the container that grants their locks."""
    wanted: dict[Address, dict[str, None]] = {}
    for handle in handles:
        wanted.setdefault(handle.key.address, {}).update(dict.fromkeys(handle.record.used))
    return {address: list(names) for address, names in wanted.items()}


def selected(
    which: Constraint | Iterable[Handle], select: Callable[[Constraint], Sequence[Handle]], verb: str = "lock"
) -> list[Handle]:
    """The services to lock or resume: those given, or the actuating ones that match.

    Raises:
        ConfigurationError: there are none, or a stop is among them.
    """
    if isinstance(which, Constraint):
        found = [handle for handle in select(which) if handle.effect == "actuate"]
        if not found:
            problem = f"nothing that matches actuates, so there is nothing to {verb}"
            problem += "; lock a service that reads by its handle" if verb == "lock" else ""
            raise ConfigurationError(where=f"{verb} of {which}", problem=problem)
        return found
    found = list(which)
    if noted := next((handle for handle in found if handle.effect == "note"), None):
        problem = "it only writes something down, so it cannot be locked"
        raise ConfigurationError(where=noted.label, problem=problem)
    if not found:
        raise ConfigurationError(where=verb, problem=f"an empty selection {verb}s nothing; name some services")
    for handle in found:
        if handle.effect == "stop":
            raise ConfigurationError(where=handle.label, problem="a stop is open to every client and cannot be locked")
    return found


def _groups_of(which: Constraint) -> list[str]:
    """The groups that a constraint names."""
    return [term.pattern for clause in which.clauses for term in clause if term.field == "group" and not term.negated]


def require_whole(which: Constraint | Iterable[Handle], handles: Sequence[Handle]) -> None:
    """Checks that a robot's group is complete (S16), and that each alternative of a union has a part (S13).

    Raises:
        IncompleteGroup: members or alternatives are missing.
    """
    if missing := absent(which, handles):
        groups = _groups_of(which) if isinstance(which, Constraint) else []
        raise IncompleteGroup(group=groups[0] if len(groups) == 1 else str(which), missing=missing)


def absent(which: Constraint | Iterable[Handle], handles: Sequence[Handle]) -> list[str]:
    """The parts of a constraint that the services lack: members of the robot file's groups, and whole alternatives."""
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
    """The alternatives of a constraint; clauses that differ only in what they exclude count as one."""
    asked: dict[frozenset[Term], list[frozenset[Term]]] = {}
    for clause in which.clauses:
        asked.setdefault(frozenset(term for term in clause if not term.negated), []).append(clause)
    return [Constraint(tuple(clauses)) for clauses in asked.values()]
