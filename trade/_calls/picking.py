"""``pick=``: which one of several services that fit is used."""

import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from functools import partial
from math import inf
from typing import Any, Final, Literal, NamedTuple, get_args

from trade._calls.handle import Handle
from trade._registry.constraints import Constraint, where
from trade._registry.registry import Record
from trade._telemetry.load import busyness
from trade.errors import ConfigurationError, TradeError, never_ran
from trade.protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey

Pick = Literal["any", "local", "least_busy", "nearest"]
"""Which one of several services to use; see `Container.call`."""

_ANSWER_S: Final = 0.5
"""A container that does not report its load within this time comes last."""


def required(pick: object, named: str) -> Pick:
    """The value as a `Pick`; raises ConfigurationError for any other."""
    found: Pick | None = next((one for one in get_args(Pick) if one == pick), None)
    if found is None:
        known = ", ".join(map(repr, get_args(Pick)))
        raise ConfigurationError(where=named, problem=f"pick is one of {known}, not {pick!r}")
    return found


def narrowed(constraint: Constraint, pick: Pick) -> Constraint:
    """The services that may be picked."""
    return constraint & where(host=socket.gethostname()) if pick == "local" else constraint


class _Report(NamedTuple):
    """What a container reports of its load, and how long that took."""

    took_s: float = inf
    busy: tuple[float, float] = (inf, inf)


class Picker:
    """Orders services, the best one first, and counts the calls that this container makes of picked ones."""

    def __init__(self, own: Address, handle: Callable[[ServiceKey], Handle]) -> None:
        self._own = own
        self._handle = handle
        self._lock = threading.Lock()
        self._under_way: Counter[Address] = Counter()

    def order(self, records: Iterable[Record], pick: Pick) -> list[Record]:
        """All of these services, the best one first."""
        mixed = list(records)
        random.shuffle(mixed)  # services that are equally good share the calls
        if pick == "any" or len(mixed) == 1:
            return mixed
        own, host = self._own, socket.gethostname()
        if pick == "local":
            return sorted(mixed, key=lambda record: record.key.address != own)
        reports = self._reports({record.key.address for record in mixed})
        if pick == "nearest":

            def distance(record: Record) -> tuple[bool, bool, float]:
                address = record.key.address
                return address != own, record.host != host, reports[address].took_s

            return sorted(mixed, key=distance)
        return sorted(mixed, key=lambda record: reports[record.key.address].busy)

    def call(self, handles: Sequence[Handle], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Calls the first one, and the next one if it is certain that the call never ran."""
        for handle in handles[:-1]:
            try:
                with self._counted(handle):
                    return handle(*args, **kwargs)
            except TradeError as error:
                if not never_ran(error, handle.key):
                    raise
        with self._counted(handles[-1]):
            return handles[-1](*args, **kwargs)

    @contextmanager
    def _counted(self, handle: Handle) -> Generator[None, None, None]:
        address = handle.key.address
        with self._lock:
            self._under_way[address] += 1
        try:
            yield
        finally:
            with self._lock:
                self._under_way[address] -= 1
                if not self._under_way[address]:
                    del self._under_way[address]

    def _reports(self, addresses: Iterable[Address]) -> dict[Address, _Report]:
        """For each container, how long it took to report its load, in seconds, and how busy it is.

        Both are infinite for one that does not report it.
        """
        began = time.monotonic()
        took: dict[Address, float] = {}

        def note(address: Address, _: object) -> None:
            took[address] = time.monotonic() - began

        loads = [self._handle(ServiceKey(address, DOMAIN, PROVIDER, "load")) for address in addresses]
        asked = {load.key.address: load.with_(deadline_s=_ANSWER_S).start() for load in loads}
        for address, run in asked.items():
            run.add_done_callback(partial(note, address))
        found: dict[Address, _Report] = {}
        for address, run in asked.items():
            found[address] = _Report()
            if run.exception() is None:
                busy = busyness(run.result(), self._under_way[address])
                found[address] = _Report(took.get(address, _ANSWER_S), busy)
        return found
