"""Base class of simulated serial buses: devices behind one line, faults of their answers, orders to them."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import msgspec

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._answer_faults import ActiveFaults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog, LogEntry
from trade_hil_sim.mechanics._device import DeviceModel
from trade_hil_sim.mechanics._truth import BusState, DeviceState, GripperTruth
from trade_hil_sim.serial._line import SerialLine

if TYPE_CHECKING:
    from typing_extensions import Self


class LineDevice(DeviceModel):
    """A device on a serial line."""

    @abstractmethod
    def next_due(self) -> float | None:
        """When `advance` should be called next; None if never."""


_Device = TypeVar("_Device", bound=LineDevice)


class DeviceLine(ABC, Generic[_Device]):
    """Devices on one serial line; a client opens `port` as it would a real adapter.

    Args:
        devices: on the bus.
        port: stable path the client opens; made here, gone after `close`.
        name: of the bus, in the log.
        log: where to record; default: a log in memory, at `log`.
        paced: take the time of the real wire, pauses before answers included; else answer as fast as possible.
        clock: the devices' clock, in seconds. The line itself keeps real time.
    """

    def __init__(
        self,
        devices: Iterable[_Device],
        port: Path,
        *,
        name: str = "bus",
        log: ByteLog | None = None,
        paced: bool = True,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self.name, self.port = name, port
        self.log = ByteLog() if log is None else log
        self._clock = clock or time.monotonic
        self._devices = list(devices)
        for device in self._devices:
            device.emit = self._emit
        self._lock = threading.RLock()
        self._faults = ActiveFaults()
        self._last_byte_at = 0.0
        self._echo = False
        self._line = SerialLine(port, self, name=name, log=self.log, paced=paced)

    def open(self) -> "Self":
        """Plug in: from now on the port can be opened."""
        self._line.open()
        return self

    def close(self) -> None:
        """Disconnect and remove the port. Idempotent; a log passed in stays open."""
        self._line.close()

    def __enter__(self) -> "Self":
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def devices(self) -> Sequence[_Device]:
        """The devices. The bus's own thread uses them, too."""
        return tuple(self._devices)

    def state(self) -> BusState:
        """The actual state of the bus and its devices, now."""
        with self._lock:
            t = self._clock()
            truths = [msgspec.structs.replace(device.state(t), bus=self.name) for device in self._devices]
        return BusState(
            name=self.name,
            port=str(self.port),
            plugged=self._line.plugged,
            devices=[truth for truth in truths if isinstance(truth, DeviceState)],
            grippers=[truth for truth in truths if isinstance(truth, GripperTruth)],
        )

    # faults and orders

    def do(self, command: faults.Command) -> None:
        """Carry out one fault or order; raises `SimulationError` if the bus lacks the device."""
        match command:
            case faults.Unplug():
                self._line.unplug()
            case faults.Replug():
                self._line.replug()
            case faults.HangUp() | faults.Local():
                raise SimulationError(f"bus {self.name} is no controller of an arm")
            case _:
                with self._lock:
                    self._do_here(command)
                self._line.nudge()

    def _do_here(self, command: faults.Command) -> None:
        t = self._clock()
        match command:
            case faults.AnswerFault():
                self._named(command.ids)
                self._faults.add(command)
            case faults.Unmute():
                self._named(command.ids)
                self._faults.unmute(command.ids)
            case faults.Heal():
                self._faults.heal()
                self._echo = False
                for device in self._devices:
                    device.heal(t)
            case faults.Echo():
                self._echo = command.on
            case faults.Unplug() | faults.Replug() | faults.HangUp() | faults.Local():
                pass
            case faults.Absent(nth=int(nth)) if nth > len(self._devices):
                raise SimulationError(f"bus {self.name} has {len(self._devices)} devices, no number {nth}")
            case faults.Absent(nth=int(nth)):
                self._devices[nth - 1].do(command, t)
            case _:
                for device in self._named(command.ids):
                    device.do(command, t)

    def _named(self, ids: tuple[int, ...] | None) -> Sequence[_Device]:
        here = {device.device_id for device in self._devices}
        if unknown := set(ids or ()) - here:
            raise SimulationError(f"bus {self.name} has no device {sorted(unknown)}; it has {sorted(here)}")
        return [device for device in self._devices if ids is None or device.device_id in ids]

    def _emit(self, entry: LogEntry) -> None:
        self.log.add(msgspec.structs.replace(entry, bus=self.name))

    # the far end of the line; called from its thread

    def wake_in_s(self) -> float | None:
        """Seconds until `wake` should be called."""
        with self._lock:
            due = min((due for device in self._devices if (due := device.next_due()) is not None), default=None)
            return None if due is None else due - self._clock()

    def wake(self) -> None:
        """Let the devices run what is due."""
        with self._lock:
            t = self._clock()
            for device in self._devices:
                device.advance(t)

    def received(self, data: bytes, t: float) -> None:
        """Bytes from the client."""
        if self._echo:
            self._line.send(data, name="echo")
        silence_s, self._last_byte_at = t - self._last_byte_at, t
        with self._lock:
            self._silent_for(silence_s)
            self._take(data, t)

    @abstractmethod
    def _silent_for(self, s: float) -> None:
        """Note how long the line was silent before the next bytes."""

    @abstractmethod
    def _take(self, data: bytes, t: float) -> None:
        """Carry out what the client sent."""

    def _answer(self, data: bytes, ids: tuple[int, ...], instruction: str, *, after_s: float, device_id: int) -> None:
        """Send an answer after the active faults were applied."""
        for piece, late_s in self._faults.shape(data, ids, instruction):
            self._line.send(piece, after_s=after_s, late_s=late_s, name=instruction, device_id=device_id)
            after_s = 0.0


def interleaved(answers: Sequence[bytes]) -> bytes:
    """Simultaneous answers as they arrive: the bytes of all, interleaved."""
    return bytes(byte for column in zip_longest(*answers) for byte in column if byte is not None)
