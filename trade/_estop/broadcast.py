"""The broadcast of e-stops (S09): orders and confirmations that wait for no receiver, and are repeated instead."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Final

import msgspec
from msgspec import Struct, structs

from trade._audit.events import Audit
from trade._security.authorizer import Authorizer
from trade.protocol.estop_messages import decode_estop_confirmed, decode_estop_order
from trade.protocol.keys import ESTOPS, Address, estop_confirmed_key, estop_key, is_chunk
from trade.protocol.messages import PROTOCOL, EstopConfirmed, EstopOrder, Malformed, encode_message
from trade.transport.base import ChannelClosed, Message, Transport

_logger = logging.getLogger("trade")

_AGAIN_S: Final = 0.1

Expected = Callable[[], set[Address]]


class EstopReport(Struct, frozen=True, rename={"without_services": "apart"}):
    """Which containers carried out an e-stop, or its clearing."""

    id: str
    """The id of the e-stop; for a clearing all ids, separated by commas."""
    confirmed: tuple[str, ...]
    """Containers (``identity/container``) that did it: their devices are at rest."""
    missing: tuple[str, ...] = ()
    """Containers with something to stop that did not answer in time."""
    failed: dict[str, str] = {}
    """Containers where a part failed, with the problem."""
    versions: dict[str, int] = {}
    """Those of the above that use another protocol version, with that version. Their services cannot be read here, so
    each of them counts as having something to stop. They ignore a clearing that does not use their own version."""

    without_services: tuple[str, ...] = ()
    """Containers that did not list their services and, by the policy, may offer none: they have nothing to stop."""

    @property
    def complete(self) -> bool:
        """Whether at least one container was found, and all of them did it."""
        return bool(self.confirmed) and not self.missing and not self.failed


class EstopBroadcast:
    """Receives and sends the orders and confirmations of one container."""

    def __init__(self, transport: Transport, own: Address, access: Authorizer, audit: Audit) -> None:
        self._access = access
        self._audit = audit
        self._own = own
        self._orders = transport.publish(estop_key(own.identity), urgent=True, droppable=True)
        self._confirmations = transport.publish(estop_confirmed_key(own), urgent=True, droppable=True)
        self._channel = transport.subscribe(ESTOPS)
        self._on_order: Callable[[EstopOrder, str], None] | None = None
        self._requests: list[dict[str, dict[Address, str]]] = []
        """For each `ask` under way, by request: the containers that have confirmed it, with their problems."""
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, name="trade-estop", daemon=True)
        self.malformed = 0

    def listen(self, on_order: Callable[[EstopOrder, str], None]) -> None:
        """Begins to receive: calls this with each order and its giver's identity. Earlier orders wait until then."""
        self._on_order = on_order
        self._thread.start()

    def confirm(self, request: str, problem: str) -> None:
        """Confirms a request, with the problem if a part failed."""
        try:
            self._confirmations.put(encode_message(EstopConfirmed(PROTOCOL, request, problem[:500])))
        except ChannelClosed:
            _logger.debug("e-stop %s is not confirmed, because the container is closing", request)

    def ask(
        self,
        orders: Sequence[EstopOrder],
        expected: Expected,
        limit_s: float,
        is_done: Callable[[], bool],
        *,
        beyond: bool = True,
    ) -> EstopReport:
        """Repeats orders until all expected containers have confirmed each of them.

        Args:
            orders: what to do.
            expected: the containers to wait for, as far as is known; once expected, a container stays expected.
            limit_s: how long to try, in seconds; also if no container is found.
            over: whether to stop repeating them: the e-stop was cleared, or is known to be done.
            beyond: whether to send them to other containers; else only this container does it.
        """
        until = time.monotonic() + limit_s
        data = [encode_message(order) for order in orders]
        awaited: set[Address] = set()
        confirmations: dict[str, dict[Address, str]] = {order.request: {} for order in orders}
        with self._changed:
            self._requests.append(confirmations)
        if (on_order := self._on_order) is not None:
            for order in orders:
                on_order(order, self._own.identity)
        while (left_s := until - time.monotonic()) > 0 and not is_done():
            for payload in data if beyond else ():
                self._orders.put(payload)
            awaited.update(expected())
            with self._changed:
                if self._changed.wait_for(partial(_confirmed, awaited, confirmations), min(_AGAIN_S, left_s)):
                    break
        with self._changed:
            self._requests = [one for one in self._requests if one is not confirmations]
        return _report(orders, awaited, list(confirmations.values()))

    # --- hearing

    def _read(self) -> None:
        while True:
            try:
                self._handle(self._channel.receive())
            except ChannelClosed:
                return
            except (Malformed, msgspec.DecodeError) as bad:
                self.malformed += 1
                if self.malformed == 1:
                    _logger.warning("dropped an e-stop message: %s (further ones are counted, not logged)", bad)
            except Exception:
                _logger.exception("an e-stop message could not be processed")

    def _handle(self, message: Message) -> None:
        _, *chunks = message.key.split("/")
        if not all(map(is_chunk, chunks)):
            raise Malformed(f"{message.key!r} is a pattern")
        if len(chunks) == 1 and self._on_order is not None:
            order = decode_estop_order(message.payload or b"", chunks[0])
            denied = self._access.denied_order(chunks[0], clears=order.opened is None)
            if denied is not None:
                self._audit.refused("trade.estop" if order.opened else "trade.estop_clear", denied, who=chunks[0])
                raise Malformed(str(denied))
            self._on_order(order, chunks[0])
        elif len(chunks) == 3:
            self._handle_confirmation(Address(*chunks), decode_estop_confirmed(message.payload or b""))

    def _handle_confirmation(self, address: Address, confirmed: EstopConfirmed) -> None:
        with self._changed:
            for confirmations in self._requests:
                if (heard := confirmations.get(confirmed.request)) is not None:
                    heard[address] = confirmed.problem
            self._changed.notify_all()

    def close(self) -> None:
        """Ends the thread. Idempotent."""
        self._channel.close()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(2)


def as_seen_here(report: EstopReport) -> EstopReport:
    """A report of another container, which may have another protocol version, with versions as this one names them."""
    return structs.replace(
        report, versions={container: one for container, one in report.versions.items() if one != PROTOCOL}
    )


def all_of(estop_id: str, reports: Iterable[EstopReport]) -> EstopReport:
    """Merges the reports of several containers about one e-stop: one confirmation of a container is enough."""
    confirmed, missing = set[str](), set[str]()
    failed, versions, without_services = dict[str, str](), dict[str, int](), set[str]()
    for report in reports:
        confirmed.update(report.confirmed)
        missing.update(report.missing)
        failed.update(report.failed)
        versions.update(report.versions)
        without_services.update(report.without_services)
    confirmed -= failed.keys()
    missing -= confirmed | failed.keys()
    without_services -= confirmed | missing | failed.keys()
    return EstopReport(
        estop_id, tuple(sorted(confirmed)), tuple(sorted(missing)), failed, versions, tuple(sorted(without_services))
    )


def _confirmed(awaited: set[Address], confirmations: Mapping[str, Mapping[Address, str]]) -> bool:
    return bool(awaited) and all(awaited <= confirmation.keys() for confirmation in confirmations.values())


def _report(
    orders: Sequence[EstopOrder], awaited: set[Address], confirmations: Sequence[Mapping[Address, str]]
) -> EstopReport:
    """The report of orders that were given together, from the confirmations of each."""
    done = awaited.intersection(*confirmations)
    problems: dict[Address, str] = {}
    for address, problem in chain.from_iterable(one.items() for one in confirmations):
        problems[address] = "; ".join(filter(None, (problems.get(address, ""), problem)))
    names = (order.cleared if order.opened is None else (order.opened.id,) for order in orders)
    return EstopReport(
        id=",".join(chain.from_iterable(names)),
        confirmed=_names(address for address in done if not problems[address]),
        missing=_names(awaited - done),
        failed={address.who: problem for address, problem in problems.items() if problem},
    )


def _names(addresses: Iterable[Address]) -> tuple[str, ...]:
    return tuple(sorted(address.who for address in addresses))
