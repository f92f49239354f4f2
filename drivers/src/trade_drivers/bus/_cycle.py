"""The exchange with the devices of one bus, whatever they are: work that waits its turn, and stops that do not."""

import logging
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, Protocol, TypeVar

from trade import Resource
from trade.errors import DeviceError, DeviceFault, DeviceSilent, TradeError
from trade_drivers.bus._jobs import Device, Work
from trade_drivers.robotfile import Bus

__all__ = ["HALT_NS", "PROBE_NS", "BusCycle", "BusDevice", "StopTicket", "silences"]

silences: Final = logging.getLogger("trade.silences")
"""Where a device that is not heard is warned of; who tells of faults by itself raises its level."""
PROBE_NS: Final = 500_000_000
"""How long a device that does not answer is left alone, at first, before it is asked again."""
HALT_NS: Final = 2_000_000_000
"""How long a device that was told to stop may take to come to rest."""
_RETRIES: Final = 3


def _lasting_ns() -> int:
    """A clock that goes on while the host is suspended, too."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) if sys.platform == "linux" else time.monotonic_ns()


class Measured(Protocol):
    """One measurement."""

    @property
    def at_ns(self) -> int:
        """When it was asked for."""
        ...


_Sample = TypeVar("_Sample", bound=Measured)


class BusDevice(ABC, Generic[_Sample]):
    """The state of one device. The bus thread writes it; other threads read whole values."""

    fault: str = ""
    """Why it refuses to move; empty if it does not."""

    def __init__(self, name: str, bus: str, resource: Resource) -> None:
        self.name = name
        self.resource = resource
        """What locks and stops attach to."""
        self.bus = bus
        """The port, for messages."""
        self.sample: _Sample | None = None
        """The newest measurement."""
        self.halting_since_ns = 0
        """When it was told to stop; 0 once it was seen at rest."""
        self.held_ns = 0
        """When it was last told to."""
        self.still = 0
        """Measurements in a row in which it did not move."""
        self.misses = 0
        """Exchanges in a row that it did not answer."""
        self.doubted = False
        """It missed an exchange and has not been heard properly since: what it sends may be an answer of before."""
        self.silent = False
        """It used up its retries: it is left out and asked now and then whether it is back."""
        self.silent_since_ns = 0
        self.probe_at_ns = 0

    @abstractmethod
    def faulty(self, fault: str = "") -> DeviceFault:
        """The error of a device with a fault; by default the latched one."""

    def age_ns(self, now_ns: int) -> int:
        """Age of the newest measurement, or the time it has been silent if there is none."""
        return now_ns - (self.sample.at_ns if self.sample else self.silent_since_ns)

    def fresh(self, now_ns: int, stale_after_ns: int) -> _Sample:
        """The newest measurement.

        Raises:
            DeviceSilent: it is too old, or there is none.
        """
        if self.sample is None or self.silent or self.age_ns(now_ns) > stale_after_ns:
            raise self.deaf(now_ns)
        return self.sample

    def deaf(self, now_ns: int) -> DeviceSilent:
        """The error of a device that does not answer."""
        return DeviceSilent(device=self.name, bus=self.bus, waited_s=self.age_ns(now_ns) / 1e9)


_Device = TypeVar("_Device", bound=BusDevice[Any])


class StopTicket(Work[_Device]):
    """A stop: it has no expiry and needs no permit, and ends when all its devices are at rest."""

    def __init__(self, devices: Sequence[_Device], halt: Callable[[], None]) -> None:
        super().__init__(devices)
        self.halt = halt
        """Writes it."""


class BusCycle(ABC, Generic[_Device]):
    """What happens on one bus.

    ``submit``, ``leave`` and what gives stops are for any thread, the rest for the one that calls ``cycle()``.
    """

    def __init__(self, bus: Bus, devices: Sequence[_Device], clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.clock = clock
        self.lasting_clock = _lasting_ns
        """Tells how long nothing was looked after, also while the whole host was suspended."""
        self.wake = threading.Event()
        """Set when something should not wait for the next cycle."""
        self.stale_after_ns = int(bus.stale_after_s * 1e9)
        self.period_ns = int(1e9 / bus.rate_hz)
        self.watchdog_ns = int(bus.watchdog_s * 1e9)
        self.refusing: Callable[[Device], TradeError] | None = None
        """Why nothing is taken on at present."""
        self.missed_answers = 0
        """Since the start."""
        self._devices = tuple(devices)
        self._inbox: deque[Work[_Device]] = deque()
        self._stops: deque[StopTicket[_Device]] = deque()
        self._working: list[Work[_Device]] = []
        self._stopping: list[StopTicket[_Device]] = []

    @abstractmethod
    def cycle(self) -> None:
        """One round: stops, measurements, work, motions.

        Raises:
            PortLost: the wire is gone.
        """

    @abstractmethod
    def halt_all(self, reason: str) -> None:
        """End every motion."""

    @abstractmethod
    def fail_motion(self, device: _Device, error_of: Callable[[Device], TradeError]) -> None:
        """End the motion of a device, if there is one, without a word on the bus."""

    @abstractmethod
    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None:
        """Stop everything, then hold or relax; waits until that is done, or the bus thread has ended.

        Raises:
            TradeError: not everything could be left so.
        """

    @property
    def devices(self) -> tuple[_Device, ...]:
        """Those on this bus."""
        return self._devices

    # --- from any thread

    def submit(self, job: Work[_Device]) -> None:
        """Take work on; the job's ``wait`` tells what became of it."""
        if self.refusing is not None:
            job.finish(self.refusing(job.devices[0]))
        else:
            self._inbox.append(job)

    def unseen(self) -> list[str]:
        """The names of the devices that nobody sees at rest: silent, or told to stop and still moving."""
        return [device.name for device in self._devices if device.silent or device.halting_since_ns]

    def absence(self, device: _Device, silent: DeviceSilent) -> DeviceError:
        """The error of a device that was not measured: why nothing is taken on at present, else its silence."""
        reason = self.refusing(device) if self.refusing is not None else None
        return reason if isinstance(reason, DeviceError) else silent

    def why(self, devices: Sequence[_Device]) -> str:
        """Why their ``stop()`` is called: an e-stop, a session that ended, services withdrawn, or just so."""
        return next((device.resource.why for device in devices if device.resource.why), "stop() was called")

    def order_stop(self, devices: Sequence[_Device], reason: str, halt: Callable[[], None]) -> StopTicket[_Device]:
        """Void what was admitted for these devices, and have ``halt`` called before anything else happens on the bus.

        It is tried while nothing is taken on, too.
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
        """Between two cycles; ends early when something came up. Stops do not wait."""
        if self.wake.wait(seconds):
            self.wake.clear()
            self.serve_stops()

    def pause(self, seconds: float) -> None:
        """Keep silent, except for stops; at least those that have come are served."""
        self.serve_stops()
        until = time.monotonic() + seconds
        while (left_s := until - time.monotonic()) > 0:
            self.idle(left_s)

    def serve_stops(self) -> None:
        """Write every stop that has come."""
        while self._stops:
            ticket = self._stops.popleft()
            if not ticket.ended:
                self._stopping.append(ticket)
            ticket.halt()

    def work(self, until_ns: int) -> None:
        """Go on with the jobs, an exchange of each in turn; a stop or the time ends the round."""
        while self._inbox:
            self._working.append(self._inbox.popleft())
        while self._working and not self._stops:
            taken: set[_Device] = set()
            for job in tuple(self._working):
                free = taken.isdisjoint(job.devices)
                taken.update(job.devices)  # also of one that waits: nobody overtakes it, and then works beside it
                if not job.ended and not free:
                    continue  # one at a time touches a device
                if job.ended or not job.step():
                    self._working.remove(job)
                    job.done_stepping()
                if self._stops:
                    break
            if self.clock() >= until_ns:
                return

    def worked_on(self, device: _Device) -> bool:
        """Whether a job is in the middle of its exchanges with this device."""
        return any(device in job.devices for job in self._working)

    def answer_stops(self, now_ns: int) -> None:
        """Tell those who wait for a stop what was seen of it."""
        for ticket in tuple(self._stopping):
            self._answer(ticket, now_ns)

    def _answer(self, ticket: StopTicket[_Device], now_ns: int) -> None:
        error: TradeError | None = None
        for device in ticket.devices:
            if device.silent or device.age_ns(now_ns) > self.stale_after_ns:
                error = device.deaf(now_ns)
            elif device.halting_since_ns and now_ns - device.halting_since_ns > HALT_NS:
                error = device.faulty("told to stop, but it is still moving")
            elif device.halting_since_ns:
                return
        self._stopping.remove(ticket)
        ticket.finish(error)

    def held_up(self, since_ns: int) -> str:
        """Why a motion that was last looked after then, by the lasting clock, must not go on; empty if it may.

        Its devices have stopped by themselves, and where it would be by now is far from where they are.
        """
        gap_ns = self.lasting_clock() - since_ns
        if gap_ns <= self.watchdog_ns:
            return ""
        return f"its driver was held up for {gap_ns / 1e9:.1f} s, longer than watchdog_s, and it stopped by itself"

    def fail_all(self, error_of: Callable[[Device], TradeError]) -> None:
        """End everything anyone waits for."""
        for device in self._devices:
            self.fail_motion(device, error_of)
        for job in (*self._working, *_drained(self._inbox), *self._stopping, *_drained(self._stops)):
            job.finish(error_of(job.devices[0]))
        self._working.clear()
        self._stopping.clear()

    def missed(self, device: _Device) -> None:
        """It has not answered: it is in doubt, and left out after three times in a row."""
        now_ns = self.clock()
        self.missed_answers += 1
        device.misses += 1
        device.doubted = True
        if device.misses >= _RETRIES and not device.silent:
            silences.warning("%s does not answer on %s", device.name, device.bus)
            device.silent, device.silent_since_ns = True, now_ns
        if device.silent:
            device.probe_at_ns = now_ns + PROBE_NS * max(1, min(4, device.misses - _RETRIES + 1))

    def forget_measurements(self) -> None:
        """The port is gone: nothing is known any more but how long ago it was."""
        now_ns = self.clock()
        for device in self._devices:
            if not device.silent:
                device.silent, device.silent_since_ns, device.probe_at_ns = True, now_ns, now_ns


_Job = TypeVar("_Job")


def _drained(queue: "deque[_Job]") -> list[_Job]:
    jobs: list[_Job] = []
    while queue:  # others may be adding to it
        jobs.append(queue.popleft())
    return jobs
