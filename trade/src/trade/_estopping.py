"""E-stops of one container, tied together: hearing and giving orders, telling of what is open, taking the union."""

import logging
import secrets
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final

from msgspec import structs

from trade._access import Access
from trade._audit import Audit
from trade._deadman import Deadman
from trade._estop import Estops
from trade._estop_line import EstopLine, EstopReport
from trade._estop_store import EstopStore
from trade._keys import Address, is_chunk
from trade._locks import LockTable
from trade._providers import Providers
from trade._registry import Change, ContainerState, Record, Registry
from trade._system import DOMAIN
from trade._transport import ChannelClosed, Transport
from trade._wire import PROTOCOL, Estop, EstopOrder, ProviderInfo
from trade.errors import ConfigurationError, NoSuchEstop

_logger = logging.getLogger("trade")

LIMIT_S: Final = 3.0
_LONGEST_LIMIT_S: Final = 60.0
_TOLD_S: Final = 1.0
"""How long the entries of others may lag behind their confirmations."""
_LONGEST_REASON: Final = 500


class Estopping:
    """``container.estop`` and its kind."""

    def __init__(
        self,
        transport: Transport,
        own: Address,
        registry: Registry,
        table: LockTable,
        providers: Providers,
        folder: Path | None,
        access: Access,
        audit: Audit,
    ) -> None:
        self._own = own
        self._registry = registry
        self._providers = providers
        self._access = access
        self._line = EstopLine(transport, own, access, audit)
        self.deadman: Final = Deadman(providers.stop_of, providers.stops, table.resources, audit)
        self._estops = Estops(
            table,
            self.deadman,
            EstopStore(folder),
            self._line.confirm,
            self._tell,
            lambda: bool(providers.stops()),
            audit,
        )
        self._provider: object = None

    def open_here(self) -> tuple[Estop, ...]:
        """What is open in this very container."""
        return self._estops.open()

    def begin(self, provider: object) -> None:
        """Hear orders from now on.

        Args:
            provider: that of e-stops, registered; its entry tells what is open, as its ``open_estops``.
        """
        self._provider = provider
        self._registry.listen(self._heard)
        self._line.listen(self._estops.take)

    @property
    def malformed(self) -> int:
        """Messages that were dropped."""
        return self._line.malformed

    # --- asking

    def estop(self, reason: str, limit_s: float) -> EstopReport:
        """See `Container.estop`."""
        _check_limit(limit_s)
        estop = Estop(secrets.token_hex(4), str(self._own), reason[:_LONGEST_REASON], time.time())
        order = EstopOrder(PROTOCOL, estop.id, estop)

        report = self._line.ask(order, self._awaited, limit_s, lambda: self._is_cleared(estop.id))
        return self._with_versions(report)

    def hear(self, tell: Callable[[Estop], None]) -> None:
        """Have this called, on a thread of its own, with every e-stop: those that are open, and those to come."""
        self._estops.heard.append(tell)
        for estop in self._estops.open():
            tell(estop)

    def deafen(self, tell: Callable[[Estop], None]) -> None:
        """Have it called no more."""
        self._estops.heard.remove(tell)

    def carry(self, estop: Estop, system: str) -> None:
        """Open an e-stop of another system here, under its id; once: it is cleared here by itself."""
        if self._estops.knows(estop.id) or not is_chunk(estop.id):
            return
        reason = f"{estop.reason} (in system {system}, by {estop.by})"[:_LONGEST_REASON]
        mine = Estop(estop.id, str(self._own), reason, estop.at)
        order = EstopOrder(PROTOCOL, estop.id, mine)
        report = self._line.ask(order, self._awaited, LIMIT_S, lambda: self._is_cleared(estop.id))
        if report.missing or report.failed:
            _logger.error("e-stop %s of system %s: missing %s, %s", estop.id, system, report.missing, report.failed)

    def _is_cleared(self, estop_id: str) -> bool:
        return all(known.id != estop_id for known in self._estops.open())

    def open(self) -> list[Estop]:
        """See `Container.estops`."""
        told = {estop.id: estop for record in self._own_records() for estop in record.estops}
        told.update((estop.id, estop) for state in self._others() for estop in state.open_estops())
        told.update((estop.id, estop) for estop in self._estops.open())
        return sorted(told.values(), key=lambda estop: (estop.at, estop.id))

    def clear(self, ids: Sequence[str], limit_s: float) -> EstopReport:
        """See `Container.estop_clear`."""
        _check_limit(limit_s)
        if isinstance(ids, str) or not ids:
            problem = "name the e-stops to clear in a list; trade.estops() tells which are open"
            raise ConfigurationError(where="estop_clear", problem=problem)
        there = [estop.id for estop in self.open()]
        if unknown := [name for name in ids if name not in there]:
            raise NoSuchEstop(ids=unknown, open=there)
        self._access.require(self._own.identity, "administer", DOMAIN, f"e-stop {', '.join(ids)}")
        order = EstopOrder(PROTOCOL, secrets.token_hex(4), None, tuple(ids))

        def expected() -> set[Address]:
            knowing = (r.key.address for r in self._own_records() if any(estop.id in ids for estop in r.estops))
            return {*self._with_stops(), *self._unread(), *knowing}

        report = self._line.ask(order, expected, limit_s, lambda: False)
        self._registry.wait_for(lambda: not self._still_told(ids, report.confirmed), _TOLD_S)
        unheeding = (state for state in self._others() if any(estop.id in ids for estop in state.open_estops()))
        names = {state.address.who for state in unheeding}
        report = structs.replace(report, missing=tuple(sorted({*report.missing, *names})))
        return self._with_versions(report)

    def _with_versions(self, report: EstopReport) -> EstopReport:
        there = {state.address.who: state.protocol for state in self._others()}
        named = {*report.confirmed, *report.missing, *report.failed}
        return structs.replace(report, versions={name: there[name] for name in sorted(there) if name in named})

    def _still_told(self, ids: Sequence[str], by: Sequence[str]) -> bool:
        """Whether the entries of those who confirmed still have them: what they say now may not have arrived."""
        return any(
            estop.id in ids for record in self._own_records() if record.key.address.who in by for estop in record.estops
        )

    def _with_stops(self) -> set[Address]:
        return {state.address for state in self._registry.containers() if _has_stop(state)}

    def _awaited(self) -> set[Address]:
        """Who has something to stop, or may have, as far as that can be known."""
        return {*self._with_stops(), *self._unread(), *(state.address for state in self._others())}

    def _unread(self) -> set[Address]:
        """Who is there and has not said yet what is its own: nobody can tell that it has nothing to stop."""
        containers = self._registry.containers()
        return {state.address for state in containers if not state.heard.complete and state.address != self._own}

    def _others(self) -> list[ContainerState]:
        """Those that speak another version."""
        return [state for state in self._registry.containers() if state.protocol not in (0, PROTOCOL)]

    def _own_records(self) -> list[Record]:
        """One record of each container, of the provider that tells what is open there."""
        containers = self._registry.containers()
        entries = [entry for state in containers for entry in list(state.providers.values())]
        return [entry.records[0] for entry in entries if _tells(entry.records)]

    # --- telling and hearing of what is open

    def learn(self, estops: Iterable[Estop]) -> None:
        """Told by the watch: a container of another version has these open."""
        self._estops.learn(estops)

    def _tell(self) -> None:
        """Let our registry entry say what is open, for those who join."""
        try:
            self._providers.alter(self._provider, lambda info: _with(info, self._estops.open()))
        except (ChannelClosed, ConfigurationError):  # the container is closing
            return

    def _heard(self, change: Change) -> None:
        """Told by the registry."""
        for record in (*change.joined, *change.replaced):
            if record.estops and not record.local:
                self._estops.learn(record.estops)
        if self._estops.open() and any(record.local and _is_stop(record) for record in change.joined):
            self._estops.keep()

    def close(self) -> None:
        """Hear no more. Idempotent."""
        self._line.close()
        self._estops.close()


def _with(info: ProviderInfo, estops: tuple[Estop, ...]) -> ProviderInfo:
    return structs.replace(info, estops=estops)


def _is_stop(record: Record) -> bool:
    return record.info.effect == "stop" and record.key.domain != DOMAIN


def _has_stop(state: ContainerState) -> bool:
    return any(_is_stop(record) for entry in list(state.providers.values()) for record in entry.records)


def _tells(records: Sequence[Record]) -> bool:
    return bool(records) and records[0].key.domain == DOMAIN


def _check_limit(limit_s: float) -> None:
    if not 0 < limit_s <= _LONGEST_LIMIT_S:
        problem = f"limit_s must be above 0 and at most {_LONGEST_LIMIT_S:g}, not {limit_s!r}"
        raise ConfigurationError(where="estop", problem=problem)
