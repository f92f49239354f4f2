"""The cyclic exchange with the devices of a bus: jobs in their order, and stops immediately."""

import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, Protocol, TypeVar

from trade import Resource
from trade.errors import DeviceError, DeviceFault, DeviceSilent, TradeError
from trade_drivers.bus._attempts import ATTEMPTS
from trade_drivers.bus._jobs import AwaitedJob, Device
from trade_robotfile import Bus

PROBE_NS: Final = 500_000_000
"""The first pause before a device that did not answer is tried again."""
HALT_NS: Final = 2_000_000_000
"""The time allowed for a device to come to rest after a stop."""
_PATIENT_NS: Final = 100_000_000
"""The pause before a device whose retries are used up is tried again, while its measurement is not too old yet."""


def _lasting_ns() -> int:
    """Returns the time of a clock that also counts while the host is suspended."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) if sys.platform == "linux" else time.monotonic_ns()


class Timestamped(Protocol):
    """One measurement."""

    @property
    def at_ns(self) -> int:
        """When the measurement was requested."""
        ...


_Sample = TypeVar("_Sample", bound=Timestamped)


class BusDevice(ABC, Generic[_Sample]):
    """The state of one device. The bus thread writes it; other threads read single values."""

    fault: str = ""
    """Why the device refuses to move; empty if it does not."""

    def __init__(self, name: str, bus: str, resource: Resource) -> None:
        self.name = name
        self.resource = resource
        """The resource for locks and stops."""
        self.bus = bus
        """The port, for messages."""
        self.sample: _Sample | None = None
        """The newest measurement."""
        self.halting_since_ns = 0
        """When a stop was sent to the device; 0 after it was seen at rest."""
        self.held_ns = 0
        """When a stop was last sent."""
        self.still = 0
        """Consecutive measurements without motion."""
        self.misses = 0
        """Consecutive exchanges without an answer."""
        self.doubted = False
        """True after a missed exchange until a proper answer: what the device sends may answer an earlier request."""
        self.silent = False
        """True after its retries are used up and its measurement is too old: it is left out, and tried now and then."""
        self.silent_since_ns = 0
        self.probe_at_ns = 0
        self.why_silent = ""
        """Why its answers are missing, if that is known."""

    @property
    def unheld(self) -> str:
        """Why the device cannot hold where it is; empty if it can."""
        return ""

    @abstractmethod
    def fault_error(self, fault: str = "") -> DeviceFault:
        """Returns the error for a fault; by default the latched one."""

    def age_ns(self, now_ns: int) -> int:
        """Returns the age of the newest measurement, or the time without any."""
        return now_ns - (self.sample.at_ns if self.sample else self.silent_since_ns)

    def fresh(self, now_ns: int, stale_after_ns: int) -> _Sample:
        """Returns the newest measurement.

        Raises:
            DeviceSilent: the measurement is too old, or there is none.
        """
        if self.sample is None or self.silent or self.age_ns(now_ns) > stale_after_ns:
            raise self.silent_error(now_ns)
        return self.sample

    def silent_error(self, now_ns: int) -> DeviceSilent:
        """Returns the error for a device that does not answer."""
        waited_s = self.age_ns(now_ns) / 1e9
        return DeviceSilent(device=self.name, bus=self.bus, waited_s=waited_s, reason=self.why_silent)


_Device = TypeVar("_Device", bound=BusDevice[Any])


class StopTicket(AwaitedJob[_Device]):
    """A stop. It never expires, needs no permit, and ends when all its devices are at rest."""

    def __init__(self, devices: Sequence[_Device], halt: Callable[[], None]) -> None:
        super().__init__(devices)
        self.halt = halt
        """Writes the stop to the bus."""


class BusCycle(ABC, Generic[_Device]):
    """The exchange with the devices of one bus.

    Any thread may call ``submit``, ``leave`` and stops; only the thread that calls ``cycle()`` may call the rest.
    """

    def __init__(self, bus: Bus, devices: Sequence[_Device], clock: Callable[[], int] | None = None) -> None:
        self.clock = clock or time.monotonic_ns
        self.lasting_clock = _lasting_ns
        """The clock that measures interruptions, including a suspended host."""
        self.wake = threading.Event()
        """Set for work that should not wait for the next cycle."""
        self.stale_after_ns = int(bus.stale_after_s * 1e9)
        self.period_ns = int(1e9 / bus.rate_hz)
        self.watchdog_ns = int(bus.watchdog_s * 1e9)
        self.refusing: Callable[[Device], TradeError] | None = None
        """Makes the error with which new work is refused at present; None while it is accepted."""
        self.missed_answers = 0
        """Number since the start."""
        self._devices = tuple(devices)
        self._inbox: deque[AwaitedJob[_Device]] = deque()
        self._stops: deque[StopTicket[_Device]] = deque()
        self._working: list[AwaitedJob[_Device]] = []
        self._stopping: list[StopTicket[_Device]] = []

    @abstractmethod
    def cycle(self) -> None:
        """Runs one cycle: stops, measurements, work, motions.

        Raises:
            PortLost: the port is gone.
        """

    @abstractmethod
    def halt_all(self, reason: str) -> None:
        """Ends all motions."""

    @abstractmethod
    def fail_motion(self, device: _Device, error_of: Callable[[Device], TradeError]) -> None:
        """Ends the motion of a device, if there is one, without sending anything."""

    @abstractmethod
    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None:
        """Stops everything, then holds or relaxes; returns when that is done, or the bus thread has ended.

        Raises:
            TradeError: a device could not be left so.
        """

    @property
    def devices(self) -> tuple[_Device, ...]:
        """The devices on this bus."""
        return self._devices

    # --- from any thread

    def submit(self, job: AwaitedJob[_Device]) -> None:
        """Queues a job; its ``wait`` returns the outcome."""
        if self.refusing is not None:
            job.finish(self.refusing(job.devices[0]))
        else:
            self._inbox.append(job)

    def unseen(self) -> list[str]:
        """Returns the names of devices not seen at rest: offline, or still moving after a stop."""
        now_ns = self.clock()
        return [
            device.name
            for device in self._devices
            if device.silent or device.halting_since_ns or device.age_ns(now_ns) > self.stale_after_ns
        ]

    def absence(self, device: _Device, silent: DeviceSilent) -> DeviceError:
        """Returns the error for a missing measurement: why new work is refused, or that the device does not answer."""
        reason = self.refusing(device) if self.refusing is not None else None
        return reason if isinstance(reason, DeviceError) else silent

    def why(self, devices: Sequence[_Device]) -> str:
        """Returns the reason of a ``stop()``: an e-stop, the end of a session, withdrawn services, or a plain call."""
        return next((device.resource.why for device in devices if device.resource.why), "stop() was called")

    def order_stop(self, devices: Sequence[_Device], reason: str, halt: Callable[[], None]) -> StopTicket[_Device]:
        """Voids all permits for these devices, and queues ``halt`` ahead of everything else on the bus.

        The stop is attempted even while new work is refused.
        """
        for device in devices:
            device.resource.stop("its driver", reason=reason)
            device.resource.why = ""
        ticket = StopTicket(devices, halt)
        if self.refusing is not None:
            ticket.finish(self.refusing(devices[0]))
        self._stops.append(ticket)
        self.wake.set()
        return ticket

    # --- from the bus thread

    def idle(self, seconds: float) -> None:
        """Waits between two cycles, serves stops immediately, and ends early for urgent work."""
        if self.wake.wait(seconds):
            self.wake.clear()
            self.serve_stops()

    def pause(self, seconds: float) -> None:
        """Sends nothing for a time except stops; serves at least those that are pending."""
        self.serve_stops()
        until = time.monotonic() + seconds
        while (left_s := until - time.monotonic()) > 0:
            self.idle(left_s)

    def serve_stops(self) -> None:
        """Writes all pending stops."""
        while self._stops:
            ticket = self._stops.popleft()
            if not ticket.ended:
                self._stopping.append(ticket)
            ticket.halt()

    def work(self, until_ns: int) -> None:
        """Runs the jobs, one exchange of each in turn, until a stop arrives or the time is up."""
        while self._inbox:
            self._working.append(self._inbox.popleft())
        while self._working and not self._stops:
            taken: set[_Device] = set()
            for job in tuple(self._working):
                free = taken.isdisjoint(job.devices)
                taken.update(job.devices)  # also of a waiting job, so that no later one overtakes it
                if not job.ended and not free:
                    continue  # only one job at a time accesses a device
                if job.ended or not job.step():
                    self._working.remove(job)
                    job.done_stepping()
                if self._stops:
                    break
            if self.clock() >= until_ns:
                return

    def why_silent(self) -> str:
        """Returns why answers are missing on this bus, if that is known. Never waits."""
        return ""

    def worked_on(self, device: _Device) -> bool:
        """Returns whether a job is between two of its exchanges with this device."""
        return any(device in job.devices for job in self._working)

    def answer_stops(self, now_ns: int) -> None:
        """Completes the stops whose devices were measured at rest, or cannot be."""
        for ticket in tuple(self._stopping):
            self._answer(ticket, now_ns)

    def _answer(self, ticket: StopTicket[_Device], now_ns: int) -> None:
        error: TradeError | None = None
        for device in ticket.devices:
            if device.silent or device.age_ns(now_ns) > self.stale_after_ns:
                error = device.silent_error(now_ns)
            elif device.halting_since_ns and now_ns - device.halting_since_ns > HALT_NS:
                why = f": {device.unheld}" if device.unheld else ""
                error = device.fault_error(f"a stop was sent, but it is still moving{why}")
            elif device.halting_since_ns:
                return
        self._stopping.remove(ticket)
        ticket.finish(error)

    def held_up(self, since_ns: int) -> str:
        """Returns why a motion last handled at this time (of the lasting clock) must not continue; empty if it may.

        After an interruption, its devices have stopped by themselves, far from the current set-point.
        """
        gap_ns = self.lasting_clock() - since_ns
        if gap_ns <= self.watchdog_ns:
            return ""
        return f"its driver was held up for {gap_ns / 1e9:.1f} s, longer than watchdog_s, and it stopped by itself"

    def fail_all(self, error_of: Callable[[Device], TradeError]) -> None:
        """Ends all work and stops with an error."""
        for device in self._devices:
            self.fail_motion(device, error_of)
        for job in (*self._working, *_drained(self._inbox), *self._stopping, *_drained(self._stops)):
            job.finish(error_of(job.devices[0]))
        self._working.clear()
        self._stopping.clear()

    def missed(self, device: _Device) -> None:
        """Records a missing answer: the device is in doubt.

        It is left out after three in a row, but not before its measurement is too old.
        """
        now_ns = self.clock()
        self.missed_answers += 1
        device.misses += 1
        device.doubted, device.why_silent = True, self.why_silent()
        if device.silent:
            device.probe_at_ns = now_ns + PROBE_NS * max(1, min(4, device.misses - ATTEMPTS + 1))
        elif device.misses >= ATTEMPTS and device.age_ns(now_ns) > self.stale_after_ns:
            device.silent, device.silent_since_ns = True, now_ns
            device.misses, device.probe_at_ns = ATTEMPTS, now_ns + PROBE_NS
        elif device.misses >= ATTEMPTS:
            device.probe_at_ns = now_ns + _PATIENT_NS

    def forget_measurements(self) -> None:
        """Invalidates all measurements after the loss of the port; keeps their age."""
        now_ns = self.clock()
        for device in self._devices:
            if not device.silent:
                device.silent, device.silent_since_ns, device.probe_at_ns = True, now_ns, now_ns


_Job = TypeVar("_Job")


def _drained(queue: "deque[_Job]") -> list[_Job]:
    jobs: list[_Job] = []
    while queue:  # other threads may be adding to it
        jobs.append(queue.popleft())
    return jobs
