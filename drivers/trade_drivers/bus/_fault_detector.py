"""Fault detection on the bus thread.

After each cycle, it compares each device with its last reported state, and reports changes without waiting.
"""

import time
from collections.abc import Callable
from typing import Any

from trade.errors import TradeError
from trade_drivers.bus._cycle import BusCycle, BusDevice
from trade_drivers.bus._jobs import Device
from trade_drivers.faults._fault_update import FaultUpdate, Respect, Tell, found_in


class _ReportedState:
    """The last reported state of one device."""

    __slots__ = ("device", "fault", "link", "refusing")

    def __init__(self, device: BusDevice[Any]) -> None:
        self.device = device
        self.fault = ""
        self.link = False
        self.refusing: Callable[[Device], TradeError] | None = None


class FaultDetector:
    """Reports each change once; changes that revert between two cycles are not reported."""

    def __init__(self, exchange: BusCycle[Any], tell: Tell) -> None:
        self._exchange = exchange
        self._tell = tell
        self._reported_states = tuple(_ReportedState(device) for device in exchange.devices)

    def look(self) -> None:
        """Compares each device with its last reported state."""
        exchange = self._exchange
        now_ns, refusing, stale_ns = exchange.clock(), exchange.refusing, exchange.stale_after_ns
        for seen in self._reported_states:
            device = seen.device
            if (fault := device.fault) != seen.fault:
                seen.fault = fault
                self._say(device, "fault", device.fault_error() if fault else None)
            if refusing is None and not device.silent and device.age_ns(now_ns) <= stale_ns:
                if seen.link:
                    seen.link, seen.refusing = False, None
                    self._say(device, "link", None)
            elif not seen.link or (refusing is not None and refusing != seen.refusing):
                seen.link, seen.refusing = True, refusing  # until it answers, only this cause is reported
                self._say(device, "link", device.silent_error(now_ns) if refusing is None else refusing(device))

    def _say(self, device: BusDevice[Any], respect: Respect, error: TradeError | None) -> None:
        found = () if error is None else found_in(device.name, error)
        self._tell(FaultUpdate(device.name, respect, time.time(), time.monotonic(), found))
