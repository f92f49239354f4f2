"""The owner thread of a bus: runs its cycles, is silent while the process is unhealthy, reopens a lost port."""

import logging
import threading
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any, Final, Generic, Protocol, TypeVar

from trade import Measure
from trade.errors import BusGone, ConfigurationError, DeviceAbsent, TradeError
from trade_drivers.bus._cycle import BusCycle
from trade_drivers.bus._fault_detector import FaultDetector
from trade_drivers.bus._jobs import Device, PortFull, PortLost, PortOpening, WireError
from trade_drivers.faults import Tell
from trade_robotfile import Bus

_log = logging.getLogger("trade")
_REOPEN_FIRST_S: Final = 0.1
_REOPEN_MOST_S: Final = 1.0


class Port(Protocol):
    """The port of a bus."""

    path: str
    """The path, for messages."""

    def open(self) -> None:
        """Opens the port; raises ``PortLost`` if it does not exist, ``PortOpening`` if it is not ready yet.

        It must not block for long, as services are answered meanwhile.
        """
        ...

    def close(self) -> None:
        """Closes the port. Idempotent."""
        ...


_Exchange_co = TypeVar("_Exchange_co", bound=BusCycle[Any], covariant=True)


class BusThread(Generic[_Exchange_co]):
    """The only thread that accesses a bus's port. Services queue jobs for it and read its measurements."""

    def __init__(self, exchange: _Exchange_co, wire: Port, bus: Bus, healthy: Callable[[], bool], name: str) -> None:
        self._exchange = exchange
        self._wire = wire
        self._bus = bus
        self._healthy = healthy
        self._sick = False
        self._lost_at = 0.0
        self._lost_why: Exception = PortLost()
        self._reopen_at = 0.0
        self._reopen_s = _REOPEN_FIRST_S
        self._leaving = False
        self.unseen: list[str] = []
        """The devices that were not seen at rest when the driver left them."""
        self._lookout: FaultDetector | None = None
        self.cycles = 0
        """Number of cycles since the start."""
        self.late = 0
        """Number of cycles that delayed the next one by a whole period."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def exchange(self) -> _Exchange_co:
        """The exchange that the thread runs."""
        return self._exchange

    def start(self) -> None:
        """Starts the cycles; the port must be open."""
        self._thread.start()

    def watched(self, tell: Tell) -> None:
        """Subscribes ``tell`` to the faults of devices, now and at each change; called on the bus thread."""
        self._lookout = FaultDetector(self._exchange, tell)

    def alive(self) -> bool:
        """Returns whether the thread is running."""
        return self._thread.is_alive()

    def measures(self, bus: str) -> list[Measure]:
        """Returns metrics of the thread; ``bus`` is its name with the robot's as prefix."""
        of, missed = {"bus": bus}, self.exchange.missed_answers
        return [
            Measure("bus_cycles", "Cycles of a bus.", self.cycles, of, "counter"),
            Measure("bus_late_cycles", "Cycles that ended too late by a period or more.", self.late, of, "counter"),
            Measure("bus_missed_answers", "Exchanges not answered in time.", missed, of, "counter"),
            Measure(
                "bus_up",
                "1: its port is open; 0: it is gone, and retried.",
                float(not self._lost_at),
                of,
            ),
        ]

    def close(self) -> None:
        """Stops everything, holds or relaxes as the robot file says, and closes the port. Idempotent.

        Raises:
            TradeError: a device could not be left as the robot file says; the port is closed nevertheless.
        """
        if self._leaving:
            return
        try:
            if self.alive():
                self.exchange.leave(self.alive, relax=self._bus.leave == "relax")
        finally:
            self.unseen = self.exchange.unseen()
            self._leaving = True
            self.exchange.wake.set()
            self._thread.join()

    # --- the thread

    def _run(self) -> None:
        problem, failed = "the thread of its bus has ended", False
        try:
            next_at = time.monotonic()
            while not self._leaving:
                self._beat()
                self._look()
                next_at = self._rest(next_at + 1 / self._bus.rate_hz)
            self._look()
        except Exception as defect:  # noqa: BLE001 - whatever it is: the bus falls silent, and the watchdogs stop the motors
            problem, failed = f"the thread of its bus failed: {defect!r}", True
            _log.exception("bus %s: its thread failed; its devices stop by their watchdogs", self._bus.name)
        finally:
            self.exchange.refusing = lambda device: device.fault_error(problem)
            self._wire.close()
            self.exchange.fail_all(self.exchange.refusing)
            if failed:
                self._look()

    def _look(self) -> None:
        if self._lookout is not None:
            try:
                self._lookout.look()
            except Exception:  # noqa: BLE001 - a failed detector ends no motion
                self._lookout = None
                _log.exception("bus %s: fault detection failed; its faults are no longer reported", self._bus.name)

    def _rest(self, next_at: float) -> float:
        """Waits for the next cycle; serves stops meanwhile."""
        exchange = self.exchange
        while (left_s := next_at - time.monotonic()) > 0:
            if self._lost_at:
                exchange.wake.wait(left_s)
                exchange.wake.clear()
            else:
                self._guarded(partial(exchange.idle, left_s))
            if self._leaving:
                break
        now = time.monotonic()
        if now - next_at < 1 / self._bus.rate_hz:  # after a small delay, the next cycle is on time again
            return next_at
        self.late += 1
        return now

    def _beat(self) -> None:
        if self._lost_at:
            self._reopen()
        elif self._is_healthy():
            self.cycles += 1
            self._guarded(self.exchange.cycle)

    def _guarded(self, act: Callable[[], None]) -> None:
        try:
            act()
        except PortLost as lost:
            _log.warning("bus %s: port %s is gone: %s", self._bus.name, self._wire.path, lost)
            self._lost_at, self._lost_why = time.monotonic(), lost
            self._reopen_s = _REOPEN_FIRST_S
            self._reopen_at = self._lost_at + self._reopen_s
            self.exchange.refusing = self._gone
            if isinstance(lost, PortFull):
                self._hold_all()
            self.exchange.forget_measurements()
            self.exchange.fail_all(self._gone)
            self._wire.close()

    def _hold_all(self) -> None:
        """Tries once more to stop everything on a bus with a full queue; what it misses is stopped by watchdogs."""
        with suppress(PortLost):
            self.exchange.serve_stops()
        self.exchange.fail_all(self._gone)
        with suppress(PortLost):
            self.exchange.halt_all("the send queue of its bus is full")

    def _gone(self, device: Device) -> TradeError:
        lost, waited_s = self._lost_why, time.monotonic() - self._lost_at
        error = lost.error if isinstance(lost, PortLost) else BusGone
        return error(device=device.name, bus=self._wire.path, waited_s=waited_s, reason=str(lost))

    def _reopen(self) -> None:
        self.exchange.fail_all(self._gone)
        if time.monotonic() < self._reopen_at:
            return
        try:
            self._wire.open()
        except PortOpening:
            self._reopen_at = time.monotonic() + _REOPEN_FIRST_S
            return
        except (PortLost, TradeError) as still:
            self._lost_why = still
            self._reopen_s = min(_REOPEN_MOST_S, 2 * self._reopen_s)
            self._reopen_at = time.monotonic() + self._reopen_s
            return
        _log.info("bus %s: port %s is back", self._bus.name, self._wire.path)
        self.exchange.fail_all(self._gone)
        self._lost_at = 0.0
        self.exchange.refusing = None

    def _is_healthy(self) -> bool:
        """Returns whether the process is healthy; if not, holds all devices once, then leaves them to watchdogs."""
        try:
            healthy = self._healthy()
        except Exception:  # noqa: BLE001 - a check that fails is a check that says no
            _log.exception("bus %s: the health check failed", self._bus.name)
            healthy = False
        if healthy == (not self._sick):
            return healthy
        self._sick = not healthy
        if self._sick:
            _log.error("bus %s: this process is not healthy; holding, then silent", self._bus.name)
            self._guarded(lambda: self.exchange.halt_all("its driver's process is not healthy"))
            self.exchange.refusing = self._unhealthy
            self.exchange.fail_all(self._unhealthy)
        else:
            self.exchange.refusing = None
        return healthy

    def _unhealthy(self, device: Device) -> TradeError:
        return device.fault_error("its driver's process is not healthy")


@contextmanager
def opening(wire: Port, port: str, where: str) -> Generator[None, None, None]:
    """Opens a serial line for a block that checks its devices; closes the line if that fails.

    Raises:
        DeviceAbsent: there is no such port.
        ConfigurationError: the port cannot be opened, or exchanges fail.
    """
    with ExitStack() as undo:
        undo.callback(wire.close)
        try:
            wire.open()
            yield
        except PortLost as lost:
            problem = f"{port}: {lost}; `ls -l /dev/serial/by-id` lists the ports"
            raise DeviceAbsent(where=f"{where}.port", problem=problem) from None
        except WireError as bad:
            problem = f"the bus does not work reliably: {bad}; check cable and power"
            raise ConfigurationError(where=f"{where}.port", problem=problem) from bad
        undo.pop_all()


_Exchange = TypeVar("_Exchange", bound=BusCycle[Any])


def start_thread(
    exchange: _Exchange, wire: Port, robot: str, bus: Bus, healthy: Callable[[], bool]
) -> BusThread[_Exchange]:
    """Starts the owner thread of a bus with an open port; closes the port if that fails."""
    with ExitStack() as undo:
        undo.callback(wire.close)
        thread = BusThread(exchange, wire, bus, healthy, name=f"bus {robot}.{bus.name}")
        thread.start()
        undo.pop_all()
    return thread
