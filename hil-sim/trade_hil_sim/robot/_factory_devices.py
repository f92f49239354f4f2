"""Buses with factory-new devices, which no robot file can describe: all of them have the same id."""

from math import pi
from pathlib import Path
from typing import Final, NamedTuple

from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog
from trade_hil_sim.robot._robot import SimulatedBus, bus_class
from trade_robotfile import Gripper, Joint, SerialBus


class _Factory(NamedTuple):
    baud: int
    device_id: int


_FACTORY: Final = {
    "dynamixel": _Factory(57_600, 1),
    "feetech": _Factory(1_000_000, 1),
    "robotiq": _Factory(115_200, 9),
}
_APART_RAD: Final = 0.2
"""Distance between the positions of their shafts."""


def fresh_bus(words: str, directory: Path, *, log: ByteLog | None = None, paced: bool = True) -> SimulatedBus:
    """The bus that ``NAME=DRIVER:MODEL,MODEL,...`` asks for, not yet open.

    Args:
        words: such as ``neck=dynamixel:XL430-W250,XL430-W250``.
        directory: of its port.
        log: where to record.
        paced: take the time of the real wire.

    Raises:
        SimulationError: the words have another form, or name something that is not simulated.
    """
    name, equals, rest = words.partition("=")
    driver, colon, models = rest.partition(":")
    if not (name and equals and colon and models):
        raise SimulationError(f"--fresh {words}: write NAME=DRIVER:MODEL,..., as in neck=dynamixel:XL430-W250")
    if driver not in _FACTORY:
        raise SimulationError(f"--fresh {words}: no driver {driver!r} here; there is {', '.join(_FACTORY)}")
    baud, device_id = _FACTORY[driver]
    bus = SerialBus(name=name, driver=driver, port=str(directory / name), baud=baud)
    devices = [_device(driver, name, number, model, device_id) for number, model in enumerate(models.split(","))]
    return bus_class(driver).from_robot(bus, devices, directory / name, log=log, paced=paced)


def _device(driver: str, bus: str, number: int, model: str, device_id: int) -> Joint | Gripper:
    name = f"{bus}.{number + 1}"
    if driver == "robotiq":
        return Gripper(
            name=name, bus=bus, id=device_id, model=model, max_width_m=0.085, max_speed_m_s=0.1, max_force_n=100.0
        )
    return Joint(
        name=name,
        bus=bus,
        id=device_id,
        model=model,
        offset_rad=_APART_RAD * number,
        min_rad=-pi,
        max_rad=pi,
        max_speed_rad_s=1.0,
        max_accel_rad_s2=10.0,
    )
