"""The simulator: the same bytes on a pseudo-terminal, written from the data sheet and not from the driver."""

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from trade_hil_sim import (
    BusState,
    ByteLog,
    Command,
    Heal,
    Late,
    Mute,
    Replug,
    SerialLine,
    SimulationError,
    Supply,
    Truncate,
    Unmute,
    Unplug,
)
from trade_robotfile import Camera, Sensor


class ThermoSim:
    """A TC-4 behind a port; its probes read 21.5 degC until a test sets another value."""

    def __init__(self, name: str, port: Path, probes: int, log: ByteLog | None = None) -> None:
        self.name, self.port = name, port
        self.celsius = [21.5] * probes
        self._lock = threading.Lock()
        self._held = b""
        self._faults: list[Mute | Late | Truncate] = []
        self._line = SerialLine(port, self, name=name, log=log, paced=False)

    @classmethod
    def from_record(
        cls,
        device: Camera | Sensor,
        port: Path,
        *,
        truth: Callable[[], Sequence[BusState]],  # noqa: ARG003 - a thermometer sees nothing of the robot
        log: ByteLog | None = None,
        paced: bool = True,  # noqa: ARG003
    ) -> "ThermoSim":
        probes = device.options.get("probes", 1)
        if not isinstance(probes, int) or not 1 <= probes <= 4:
            raise SimulationError(f"{device.key}.probes: a TC-4 has 1 to 4, not {probes!r}")
        return cls(device.name, port, probes, log)

    def open(self) -> "ThermoSim":
        self._line.open()
        return self

    def close(self) -> None:
        self._line.close()

    def state(self) -> BusState:
        return BusState(name=self.name, port=str(self.port), plugged=self._line.plugged)

    def do(self, command: Command) -> None:
        match command:
            case Unplug():
                self._line.unplug()
            case Replug():
                self._line.replug()
            case Mute() | Late() | Truncate():
                with self._lock:
                    self._faults.append(command)
            case Heal() | Unmute():
                with self._lock:
                    self._faults.clear()
            case Supply(temperature_c=int(celsius)):
                with self._lock:
                    self.celsius = [float(celsius)] * len(self.celsius)
            case _:
                raise SimulationError(f"a TC-4 has no such thing as {type(command).__name__}")

    # the far end of the line; called from its thread

    def received(self, data: bytes, t: float) -> None:  # noqa: ARG002
        self._held += data
        *requests, self._held = self._held.split(b"\n")
        for request in requests:
            if len(request) == 2 and request[:1] == b"R" and request[1:].isdigit():
                self._answer(request[1:].decode())

    def wake_in_s(self) -> float | None:
        return None

    def wake(self) -> None: ...

    def _answer(self, digit: str) -> None:
        with self._lock:
            values = " ".join(f"{value:.1f}" + ("" if -50 <= value <= 400 else "?") for value in self.celsius)
            faults = list(self._faults)
        text = f"{digit} TC-4 {values}".encode()
        check = 0
        for byte in text:
            check ^= byte
        answer, late_s = text + b"*%02X\n" % check, 0.0
        for fault in faults:
            match fault:
                case Mute():
                    return
                case Late():
                    late_s += fault.s
                case Truncate():
                    answer = answer[: -fault.missing]
        self._line.send(answer, late_s=late_s, name="R")
