"""The e-stop controller of a container: it gives and takes orders, and publishes and merges open e-stops."""

import logging
import secrets
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Final, Protocol

from msgspec import structs

from trade._audit.events import Audit
from trade._estop.broadcast import EstopBroadcast, EstopReport, all_of
from trade._estop.deadman import Deadman
from trade._estop.latch import EstopLatch
from trade._estop.ledger import as_reported
from trade._estop.store import EstopStore
from trade._registry.registry import Change, ContainerState, Record, Registry
from trade._resources.lock_table import LockTable
from trade._security.authorizer import Authorizer
from trade._services.providers import Providers
from trade._settings import Settings
from trade.errors import ConfigurationError, NoSuchEstop
from trade.protocol.estop_messages import new_estop_id
from trade.protocol.keys import DOMAIN, Address, is_chunk
from trade.protocol.messages import MOST_CLEARED, PROTOCOL, Estop, EstopOrder, ProviderInfo
from trade.transport.base import ChannelClosed, Transport

_logger = logging.getLogger("trade")

LIMIT_S: Final = 3.0
_LONGEST_LIMIT_S: Final = 60.0
_ENTRY_LAG_S: Final = 1.0
"""How long the registry entries of others may lag behind their confirmations."""
_LONGEST_REASON: Final = 500


_SOON_ROUNDS: Final = 5
"""After so many rounds of 0.1 s without a report of all, others are asked to give the e-stop, too."""


class OtherReports(Protocol):
    """An e-stop under way on the stop lines, or through other containers."""

    def report(self) -> EstopReport: ...

    def wait(self) -> EstopReport: ...


Beside = Callable[[str, str, float], OtherReports]
"""Begins an e-stop on another way, by its id, reason and limit."""


class EstopController:
    """The e-stop methods of a container: ``container.estop`` and others."""

    def __init__(
        self,
        transport: Transport,
        own: Address,
        registry: Registry,
        table: LockTable,
        providers: Providers,
        settings: Settings,
        access: Authorizer,
        audit: Audit,
    ) -> None:
        self._own = own
        self._registry = registry
        self._providers = providers
        self._access = access
        self._broadcast = EstopBroadcast(transport, own, access, audit)
        self.deadman: Final = Deadman(providers.stop_of, providers.stops, table.resources, audit)
        self._estops = EstopLatch(
            table,
            self.deadman,
            EstopStore(settings, own),
            self._broadcast.confirm,
            self._publish,
            lambda: bool(providers.stops()),
            audit,
        )
        self._provider: object = None
        self._stop_lines: Beside | None = None
        self._other_containers: Beside | None = None

    def open_here(self) -> tuple[Estop, ...]:
        """The e-stops that are open in this container."""
        return self._estops.open()

    def knows(self, estop_id: str) -> bool:
        """Whether that e-stop was opened or cleared here."""
        return self._estops.knows(estop_id)

    def begin(self, provider: object, lines: Beside | None = None, through: Beside | None = None) -> None:
        """Begins to take orders.

        Args:
            provider: the registered provider of e-stops; its entry lists the open ones, as its ``open_estops``.
            lines: begins an e-stop on the stop lines of others.
            through: begins it in other containers, which may see more.
        """
        self._provider = provider
        self._stop_lines = lines
        self._other_containers = through
        self._registry.changes.subscribe(self._on_change)
        self._broadcast.listen(self._estops.take)

    @property
    def malformed(self) -> int:
        """The number of messages that were dropped."""
        return self._broadcast.malformed

    # --- asking

    def estop(self, reason: str = "", *, limit_s: float = LIMIT_S, estop_id: str = "") -> EstopReport:
        """Stops everything in the whole system, and lets nothing move until the e-stop is cleared (S09).

        It waits for no receiver, and is repeated until every container with a stop service has confirmed that all its
        devices are at rest. Read the report: `EstopReport.complete`. This is software, not safety-rated.

        Args:
            reason: why, for people.
            limit_s: how long to try, in seconds; also if no other container is found.
            estop_id: its id, in letters, digits, ``.``, ``_`` and ``-``; the same id means the same e-stop. Empty: a
                new id.
        """
        check_limit(limit_s)
        check_id(estop_id or "new")
        estop = Estop(estop_id or new_estop_id(), str(self._own), reason[:_LONGEST_REASON], time.time())
        order = EstopOrder(PROTOCOL, estop.id, estop)

        until = time.monotonic() + limit_s
        others: list[OtherReports] = []
        rounds = 0

        def begin(way: Beside | None) -> None:
            if way is not None:
                others.append(way(estop.id, estop.reason, max(0.1, until - time.monotonic())))

        def is_done() -> bool:
            nonlocal rounds
            rounds += 1
            if rounds == 2:  # the links alone did not do it at once
                begin(self._stop_lines)
            if rounds == _SOON_ROUNDS:
                begin(self._other_containers)
            return self._estops.is_cleared(estop.id) or self._is_done(
                all_of(estop.id, [one.report() for one in others])
            )

        report = self._broadcast.ask([order], self._awaited, limit_s, is_done)
        if not others:
            begin(self._stop_lines)  # for containers without a link
        done = report.complete and any(container != self._own.who for container in report.confirmed)
        found = [one.report() if done else one.wait() for one in others]
        return self._with_versions(all_of(estop.id, [report, *found]))

    def _is_done(self, report: EstopReport) -> bool:
        """Whether the report covers all containers that are known here."""
        known = {address.who for address in self._awaited()} - {self._own.who}
        return report.complete and known <= {*report.confirmed, *report.failed}

    def relay(self, estop_id: str, reason: str, limit_s: float, *, beyond: bool) -> EstopReport:
        """Carries out an e-stop of another container, in the whole system or in this container only.

        Its report names the version of each container: who asks may have another one than this container.
        """
        check_limit(limit_s)
        check_id(estop_id)
        mine = Estop(estop_id, str(self._own), reason[:_LONGEST_REASON], time.time())
        order = EstopOrder(PROTOCOL, estop_id, mine)
        expected = self._awaited if beyond else lambda: {self._own}
        cleared = partial(self._estops.is_cleared, estop_id)
        report = self._broadcast.ask([order], expected, limit_s, cleared, beyond=beyond)
        named = {*report.confirmed, *report.missing, *report.failed}
        known = {state.address.who: state.protocol for state in self._registry.containers() if state.protocol}
        versions = {
            container: version
            for container, version in {**known, self._own.who: PROTOCOL}.items()
            if container in named
        }
        return structs.replace(self._with_versions(report), versions=versions)

    def subscribe(self, callback: Callable[[Estop], str]) -> None:
        """Calls this, on another thread, with every open and every future e-stop; it returns the problem, or empty.

        A future one is confirmed here once each callback has returned.
        """
        self._estops.subscribe(callback)

    def unsubscribe(self, callback: Callable[[Estop], str]) -> None:
        """Calls it no more."""
        self._estops.unsubscribe(callback)

    def carry(self, estop: Estop, system: str) -> str:
        """Opens an e-stop of another system here, under its id, once; it is cleared here separately.

        Returns the containers that have not confirmed it, as a text; empty if all have.
        """
        if self._estops.knows(estop.id) or not is_chunk(estop.id):
            return ""
        reason = f"{estop.reason} (in system {system}, by {estop.by})"[:_LONGEST_REASON]
        mine = Estop(estop.id, str(self._own), reason, estop.at)
        order = EstopOrder(PROTOCOL, estop.id, mine)
        report = self._broadcast.ask([order], self._awaited, LIMIT_S, lambda: self._estops.is_cleared(estop.id))
        if report.missing or report.failed:
            _logger.error("e-stop %s of system %s: missing %s, %s", estop.id, system, report.missing, report.failed)
        failed = [f"{name}: {problem}" for name, problem in report.failed.items()]
        return "; ".join([*(f"{name} has not confirmed" for name in report.missing), *failed])

    def estops(self) -> list[Estop]:
        """The e-stops that are open anywhere in the system, oldest first."""
        found: dict[str, Estop] = {}
        for reporter, estops in self._reported():
            for estop in as_reported(estops, reporter):
                if estop.id not in found or not estop.told_by:  # the giver's own report has precedence
                    found[estop.id] = estop
        found.update((estop.id, estop) for estop in self._estops.open())
        return sorted(found.values(), key=lambda estop: (estop.at, estop.id))

    def estop_clear(self, ids: Sequence[str], *, limit_s: float = LIMIT_S) -> EstopReport:
        """Clears e-stops by their ids; once none is open, calls can run again. Nothing moves by itself.

        A resource that another client's e-stop stopped during use also holds until `resume` (S08). A container that is
        unreachable now keeps them open until they are cleared again.

        Args:
            ids: the ids that `estops` returns.
            limit_s: how long to try, in seconds.

        Raises:
            NoSuchEstop: no container has an open e-stop of one of these ids; nothing is cleared then.
            AccessDenied: the policy does not let this container administer the system.
        """
        check_limit(limit_s)
        if isinstance(ids, str) or not ids:
            problem = "name the e-stops to clear in a list; trade.estops() returns the open ones"
            raise ConfigurationError(where="estop_clear", problem=problem)
        there = [estop.id for estop in self.estops()]
        if unknown := [name for name in ids if name not in there]:
            raise NoSuchEstop(ids=unknown, open=there)
        self._access.require(self._own.identity, "administer", DOMAIN, f"e-stop {', '.join(ids)}")
        pieces = [tuple(ids[first : first + MOST_CLEARED]) for first in range(0, len(ids), MOST_CLEARED)]
        orders = [EstopOrder(PROTOCOL, secrets.token_hex(4), None, piece) for piece in pieces]

        def knowing() -> set[Address]:
            reporting = (r for r in self._own_records() if any(estop.id in ids for estop in r.estops))
            return {record.key.address for record in reporting}

        before = knowing()  # a container that clears them at once does not report them any more

        def expected() -> set[Address]:
            return {*self._with_stops(), *self._unread(), *before, *knowing()}

        report = self._broadcast.ask(orders, expected, limit_s, lambda: False)
        self._registry.wait_for(lambda: not self._still_reported(ids, report.confirmed), _ENTRY_LAG_S)
        unheeding = (state for state in self._others() if any(estop.id in ids for estop in state.open_estops()))
        names = {state.address.who for state in unheeding}
        report = structs.replace(report, missing=tuple(sorted({*report.missing, *names})))
        return self._with_versions(report)

    def _with_versions(self, report: EstopReport) -> EstopReport:
        there = {state.address.who: state.protocol for state in self._others()}
        named = {*report.confirmed, *report.missing, *report.failed}
        unable = (state.address for state in self._silent() if not self._access.may_have_stops(state.address.identity))
        return structs.replace(
            report,
            versions={name: there[name] for name in sorted(there) if name in named},
            without_services=tuple(sorted({address.who for address in unable} - named)),
        )

    def _still_reported(self, ids: Sequence[str], by: Sequence[str]) -> bool:
        """Whether the entries of confirming containers still list them: a newer entry may be on its way."""
        return any(
            estop.id in ids for record in self._own_records() if record.key.address.who in by for estop in record.estops
        )

    def _with_stops(self) -> set[Address]:
        return {state.address for state in self._registry.containers() if _has_stop(state)}

    def _awaited(self) -> set[Address]:
        """The containers that have something to stop, or may have, as far as is known."""
        return {*self._with_stops(), *self._unread(), *(state.address for state in self._others())}

    def _unread(self) -> set[Address]:
        """Containers that have not listed their services yet, and so may have something to stop."""
        return {state.address for state in self._silent() if self._access.may_have_stops(state.address.identity)}

    def _silent(self) -> list[ContainerState]:
        containers = self._registry.containers()
        return [state for state in containers if not state.heard.complete and state.address != self._own]

    def _others(self) -> list[ContainerState]:
        """The containers of another protocol version."""
        return [state for state in self._registry.containers() if state.protocol not in (0, PROTOCOL)]

    def _reported(self) -> list[tuple[Address, Sequence[Estop]]]:
        """The open e-stops that each container reports, of any protocol version."""
        same_version = [(record.key.address, record.estops) for record in self._own_records()]
        return [*same_version, *((state.address, state.open_estops()) for state in self._others())]

    def _own_records(self) -> list[Record]:
        """One record for each container of this version: a service of the provider that reports its open e-stops."""
        containers = self._registry.containers()
        entries = [entry for state in containers for entry in list(state.providers.values())]
        return [entry.records[0] for entry in entries if _reports(entry.records)]

    # --- reporting and learning open e-stops

    def learn(self, estops: Iterable[Estop], reporter: Address) -> None:
        """Takes the open e-stops of a container of another version; called by the registry listener."""
        self._estops.learn(estops, reporter)

    def _publish(self) -> None:
        """Lists the open e-stops in this container's registry entry, for containers that join."""
        try:
            self._providers.alter(self._provider, lambda info: _with(info, self._estops.open()))
        except (ChannelClosed, ConfigurationError):  # the container is closing
            return
        self._learn_from_all()

    def _learn_from_all(self) -> None:
        """Learns e-stops again that had no room here before."""
        for reporter, estops in self._reported():
            if reporter != self._own:
                self._estops.learn(estops, reporter)

    def _on_change(self, change: Change) -> None:
        """Handles a change of the registry."""
        for record in (*change.joined, *change.replaced):
            if record.estops and not record.local:
                self._estops.learn(record.estops, record.key.address)
        if self._estops.open() and any(record.local and is_stop(record) for record in change.joined):
            self._estops.keep()

    def close(self) -> None:
        """Takes no more orders. Idempotent."""
        self._broadcast.close()
        self._estops.close()


def check_id(estop_id: str) -> None:
    """Raises ConfigurationError if it is not a valid id of an e-stop."""
    if not is_chunk(estop_id):
        raise ConfigurationError(where="estop", problem=f"{estop_id!r} is not an id; use letters, digits, . _ -")


def _with(info: ProviderInfo, estops: tuple[Estop, ...]) -> ProviderInfo:
    return structs.replace(info, estops=estops)


def is_stop(record: Record) -> bool:
    """Whether it is a stop service, other than the middleware's own."""
    return record.info.effect == "stop" and record.key.domain != DOMAIN


def _has_stop(state: ContainerState) -> bool:
    return any(is_stop(record) for entry in list(state.providers.values()) for record in entry.records)


def _reports(records: Sequence[Record]) -> bool:
    return bool(records) and records[0].key.domain == DOMAIN


def check_limit(limit_s: float, where: str = "estop") -> None:
    """Raises ConfigurationError if it is not a valid time limit of a stop, in seconds."""
    if not 0 < limit_s <= _LONGEST_LIMIT_S:
        problem = f"limit_s must be above 0 and at most {_LONGEST_LIMIT_S:g}, not {limit_s!r}"
        raise ConfigurationError(where=where, problem=problem)
