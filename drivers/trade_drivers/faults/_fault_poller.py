"""Collects faults from bus threads and recent measurements of devices, for the log and for the health of providers."""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

from trade.errors import DeviceFault, TradeError
from trade.protocol.messages import HEALTHY
from trade_drivers.faults._fault_update import DetectedFault, FaultUpdate, found_in
from trade_drivers.faults._log import FaultLog
from trade_drivers.faults._record import Moment, when
from trade_drivers.interfaces._arm import Arm, ArmState
from trade_drivers.interfaces._motion import Gripper, Motor
from trade_drivers.interfaces._sensing import Sensor

_EVERY_S: Final = 0.04
_HEALTH_EVERY_S: Final = 0.5
_KEPT: Final = 50
"""Number of measurements kept for each device: two seconds of them."""
_END_S: Final = 5.0
_END: Final = FaultUpdate("", "fault", 0.0, 0.0)
"""The last item of the queue."""
_MEASURING: Final = (Motor, Gripper, Arm, Sensor)

Health = Callable[[], str]
"""Judges a device, for example by its bus: ``HEALTHY``, or what is wrong."""


def _ignored(_provider: object, _health: str) -> None:
    pass


class FaultPoller:
    """A thread for the devices of one robot; unlike bus threads, it may wait.

    Args:
        log: receives each fault that begins or ends.
        name: of the thread.
        set_health: receives each change of a provider's health.
    """

    def __init__(self, log: FaultLog, name: str, set_health: Callable[[object, str], object] = _ignored) -> None:
        self._log = log
        self._set_health = set_health
        self._healths: Mapping[object, Sequence[Health]] = {}
        self._reported: dict[object, str] = {}
        """The health of each provider that was reported last."""
        self._queue: queue.SimpleQueue[FaultUpdate] = queue.SimpleQueue()
        self._devices: dict[str, Any] = {}
        self._asked: frozenset[str] = frozenset()
        self._lately: dict[str, deque[Moment]] = {}
        self._known: dict[tuple[str, str], dict[str, DetectedFault]] = {}
        """Current faults by device and respect."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def tell(self, update: FaultUpdate) -> None:
        """Queues a detected change; never waits."""
        self._queue.put(update)

    def start(
        self, devices: Mapping[str, object], asked: Collection[str], healths: Mapping[object, Sequence[Health]] = {}
    ) -> None:
        """Starts the thread.

        Args:
            devices: devices by name; those without measurements are left out.
            asked: the names of devices whose bus reports no faults; the thread polls them 25 times a second.
            healths: each provider with what judges its health, twice a second; the first result that is not healthy
                counts.
        """
        self._healths = healths
        self._devices = {name: device for name, device in devices.items() if isinstance(device, _MEASURING)}
        self._asked = frozenset(asked) & frozenset(self._devices)
        self._lately = {name: deque(maxlen=_KEPT) for name in self._devices}
        self._thread.start()

    def close(self) -> None:
        """Ends the thread after it has logged all queued changes. Idempotent."""
        self._queue.put(_END)
        if self._thread.ident is not None:
            self._thread.join(_END_S)

    # --- the thread

    def _run(self) -> None:
        due_s = health_due_s = time.monotonic()
        while (update := self._next(due_s)) is not _END:
            if update is not None:
                self._take(update)
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + _EVERY_S
                self._look_at_all()
                self._log.save()
            if time.monotonic() >= health_due_s:
                health_due_s = time.monotonic() + _HEALTH_EVERY_S
                self._report_health()

    def _next(self, due_s: float) -> FaultUpdate | None:
        try:
            return self._queue.get(timeout=max(0.0, due_s - time.monotonic()))
        except queue.Empty:
            return None

    def _look_at_all(self) -> None:
        for name in self._devices:
            found = self._measure(name)
            if name in self._asked:
                self._take(FaultUpdate(name, "fault", time.time(), time.monotonic(), found))

    def _report_health(self) -> None:
        for provider, judges in self._healths.items():
            health = next((text for judge in judges if (text := judge()) != HEALTHY), HEALTHY)
            if health != self._reported.get(provider, HEALTHY):
                with suppress(TradeError):  # the provider is not registered yet, or not any more: it is tried again
                    self._set_health(provider, health)
                    self._reported[provider] = health

    def _measure(self, name: str) -> tuple[DetectedFault, ...]:
        """Keeps a device's measurement if it is new, and returns the faults that the device itself reports."""
        device, lately = self._devices[name], self._lately[name]
        try:
            state = device.read() if isinstance(device, Sensor) else device.state()
            at_s, fault = when(state), str(getattr(state, "fault", ""))
        except Exception as error:  # noqa: BLE001 - a bug in the driver becomes a fault, and ends nothing
            return found_in(name, error)
        if not lately or lately[-1][0] < at_s:
            lately.append((at_s, state))
        remedy = state.remedy if isinstance(state, ArmState) else "remove the cause, then enable it again"
        return found_in(name, DeviceFault(device=name, bus="", fault=fault, remedy=remedy)) if fault else ()

    def _take(self, update: FaultUpdate) -> None:
        device = update.device
        before = self._known.get((device, update.respect), {})
        now = {found.kind: found for found in update.found}
        self._known[device, update.respect] = now
        for kind in before:
            if kind not in now:
                self._log.end(device, kind, update.at, update.at_s)
        begun = [found for kind, found in now.items() if kind not in before]
        if begun and device in self._devices:
            self._measure(device)
        for found in begun:
            self._log.begin(device, found, update.at, update.at_s, tuple(self._lately.get(device, ())))
