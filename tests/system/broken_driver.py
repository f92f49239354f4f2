"""A driver broken on purpose, in one way: ``broken_driver.py HOW COMMAND...``; the judge of the siege must see it."""

import sys
from collections.abc import Callable
from typing import Any, Final

from trade._deadman import Deadman
from trade._dispatch import LocalService
from trade._ongoing import Once
from trade._resources import Permit, Resource
from trade_drivers.dynamixel import _sdk
from trade_drivers.dynamixel._table import BUS_WATCHDOG
from trade_gateway.cli import main


def _nothing_stops() -> None:
    """Who is gone, and what he has lost, is of no concern."""
    Deadman.stop = lambda self, resources, reason, done: [done(resource, "") for resource in resources]  # type: ignore[method-assign,return-value,assignment]
    Permit.gate = lambda self: None  # type: ignore[method-assign]


def _anybody_may() -> None:
    """No lock is looked at."""
    Resource.check = lambda self, *_: None  # type: ignore[method-assign]
    Permit.gate = lambda self: None  # type: ignore[method-assign]


def _never_late() -> None:
    """Calls run however late they come."""
    LocalService.too_late = lambda self, _: False  # type: ignore[method-assign]


def _never_again() -> None:
    """A call that comes again runs again."""
    Once.begin = lambda self, call, ongoing: ongoing  # type: ignore[method-assign]
    Once.find = lambda self, caller, call: None  # type: ignore[method-assign]


def _no_watchdog() -> None:
    """Servos are not told to look after themselves."""
    write = _sdk.Wire.write

    def writing(self: Any, device_id: int, address: int, data: bytes, *rest: Any) -> None:
        write(self, device_id, address, bytes(len(data)) if address == BUS_WATCHDOG.address else data, *rest)

    _sdk.Wire.write = writing  # type: ignore[method-assign]


HOW: Final[dict[str, Callable[[], None]]] = {
    "nothing-stops": _nothing_stops,
    "anybody-may": _anybody_may,
    "never-late": _never_late,
    "never-again": _never_again,
    "no-watchdog": _no_watchdog,
}

if __name__ == "__main__":
    HOW[sys.argv.pop(1)]()
    main()
