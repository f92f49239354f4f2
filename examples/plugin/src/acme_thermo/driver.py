"""The driver: how a TC-4 is asked. The thread, the age of readings, silence and coming back are PolledSensor's."""

from functools import reduce
from typing import Annotated

import serial
from msgspec import Meta, Struct

import trade_robotfile
from trade_drivers import Measured, PolledSensor, SenseDriver, SensorInfo


class Options(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the robot file may say; anything else is refused with these keys."""

    port: Annotated[str, Meta(min_length=1)]
    probes: Annotated[int, Meta(ge=1, le=4)] = 1


class Thermo(PolledSensor):
    """One TC-4: a number with one probe, a vector with more."""

    def __init__(self, name: str, port: str, probes: int) -> None:
        size = probes if probes > 1 else 0
        info = SensorInfo(name=name, model="TC-4", unit="degC", size=size, low=-50.0, high=400.0, rate_hz=10.0)
        super().__init__(info, port)
        self._probes, self._digit = probes, 0
        self._line: serial.Serial | None = None

    def open(self) -> None:
        self._line = serial.Serial(self.port, 9600, timeout=0.3, write_timeout=0.3, exclusive=True)

    def measure(self) -> Measured:
        self._digit = (self._digit + 1) % 10  # an answer that comes too late is not the answer to the next question
        if self._line is None:
            raise OSError("the port is not open")
        self._line.write(b"R%d\n" % self._digit)
        answer = self._line.read_until(b"\n", 80)
        text, star, check = answer.rstrip(b"\n").partition(b"*")
        if not star or int(check, 16) != reduce(lambda a, b: a ^ b, text, 0):
            raise ValueError(f"no whole answer came, but {answer!r}")
        digit, model, *values = text.decode("ascii").split()
        if (digit, model) != (str(self._digit), "TC-4"):
            raise ValueError(f"it does not answer as a TC-4 does, but {answer!r}")
        if len(values) != self._probes:
            raise ValueError(f"it has {len(values)} probes; the robot file says {self._probes}")
        numbers = [float(value.rstrip("?")) for value in values]
        return Measured(numbers if self._probes > 1 else numbers[0], "doubtful" if b"?" in text else "good")

    def hang_up(self) -> None:
        if self._line is not None:
            self._line.close()


class ThermoDriver(SenseDriver):
    def attach(self, name: str, device: trade_robotfile.Camera | trade_robotfile.Sensor, port: str | None) -> Thermo:
        options = device.options_as(Options)
        return Thermo(name, port or options.port, options.probes).start(f"{device.where}: {device.key}.port")
