"""A simulated leg of two drives in this process, the driver attached to it, and the simulator's log as the judge."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.drivers.bus_rig import BusRig
from trade.errors import TradeError
from trade_drivers import Motor, Robot, parse
from trade_hil_sim import LogEntry, frames
from trade_hil_sim.cia402 import Cia402Bus

LEG = """
[robot]
name = "rosie"

[bus.legs]
driver = "cia402"
interface = "socketcan"
channel = "can0"

[joint."leg.hip"]
bus = "legs"
id = 1
model = "ACME-EC60"
counts_per_rev = 4096
gear = 50
min_rad = -1.0
max_rad = 1.0
max_speed_rad_s = 2.0
max_accel_rad_s2 = 20.0

[joint."leg.knee"]
bus = "legs"
id = 2
model = "ACME-EC60"
counts_per_rev = 4096
gear = 50
reversed = true
offset_rad = 0.2
min_rad = -1.0
max_rad = 1.0
max_speed_rad_s = 2.0
max_accel_rad_s2 = 20.0

[group.leg]
joints = ["leg.hip", "leg.knee"]
"""
PATIENT = ('channel = "can0"', 'channel = "can0"\nwatchdog_s = 2')
"""A change for where the host is busy, or the bus is held up: drives that do not stop at once."""
HIP, KNEE = 1, 2
PROFILE_POSITION, PROFILE_VELOCITY, HOMING, CYCLIC_POSITION, CYCLIC_VELOCITY = 1, 3, 6, 8, 9
GO = 1 << 4
HALT = 1 << 8
COUNTS_PER_RAD = 4096 * 50 / 6.283185307179586


def only(*modes: int) -> Callable[[Cia402Bus], None]:
    """Drives that say that they have these modes of operation and no others."""

    def change(bus: Cia402Bus) -> None:
        for device in bus.devices:
            device.store.set("supported_modes", sum(1 << mode - 1 for mode in set(modes)))  # type: ignore[attr-defined]

    return change


class Leg(BusRig):
    """Two drives: on an adapter of their own, or on an interface of the system."""

    original, file = LEG, "leg.toml"

    def __init__(self, undo: ExitStack, interface: str = "", rate_hz: int = 20) -> None:
        self._rate_hz = rate_hz  # on an interface
        self.interface = interface
        super().__init__(Path("unused"), undo)

    def read(self, text: str) -> Robot:
        if self.interface:  # where there is one slow processor, and each frame costs several calls of the system
            text = text.replace('"can0"', f'"{self.interface}"\nrate_hz = {self._rate_hz}\nstale_after_s = 1')
        self.text = text
        return parse(text, self.file)

    def plug(self, *, prepare: Callable[[Cia402Bus], None] = lambda _: None, paced: bool = False) -> Cia402Bus:
        bus = self.robot.buses[0]
        joints, options = self.robot.joints_on(bus.name), {"paced": paced, "interface": self.interface}
        self.open(Cia402Bus.from_robot(bus, joints, self._tmp_path, **options), prepare)
        wait_until(lambda: {e.device_id for e in self.frames("boot_up")} >= {HIP, KNEE}, "both have booted")
        return self.sim

    @property
    def ports(self) -> dict[str, str]:
        return {} if self.interface else super().ports  # the robot file names the interface

    def listen(self) -> can.BusABC:
        """Another client of the bus."""
        if self.interface:
            return can.Bus(interface="socketcan", channel=self.interface)
        address, _, channel = self.sim.port.removeprefix("socketcand:").partition("/")
        host, _, port = address.partition(":")
        return can.Bus(interface="socketcand", host=host, port=int(port), channel=channel, tcp_tune=True)

    def frames(self, name: str | None = None, device_id: int | None = None, since: float = 0.0) -> list[LogEntry]:
        return frames(self.log, name, device_id=device_id, since=since)

    def controlwords(self, device_id: int, since: float = 0.0) -> list[int]:
        """All that was commanded by frames, in order."""
        return [int.from_bytes(e.data[:2], "little") for e in self.frames("rpdo1", device_id, since)]

    def goals(self, device_id: int, since: float = 0.0) -> list[int]:
        """The positions of all set-points that were raised."""
        found = self.frames("rpdo1", device_id, since)
        words = [int.from_bytes(e.data[:2], "little") for e in found]
        return [
            int.from_bytes(e.data[2:], "little", signed=True) for e, word in zip(found, words, strict=True) if word & GO
        ]

    def drive(self, device_id: int) -> Any:
        """The simulated drive itself, to be changed before the bus is open."""
        return next(device for device in self.sim.devices if device.device_id == device_id)


def fault_of(motor: Motor) -> str:
    """What is latched; a joint that is silent has none to tell."""
    try:
        return motor.state().fault
    except TradeError:
        return ""


def stop_by_nmt(leg: Leg, node: int) -> None:
    """Have network management stop a drive; returns once its heartbeat says so."""
    with leg.listen() as other:
        other.send(can.Message(arbitration_id=0, data=bytes((0x02, node)), is_extended_id=False))
        wait_until(lambda: any(e.data == b"\x04" for e in leg.frames("heartbeat", node)[-1:]), "it is stopped")


def turned_by_another(leg: Leg, speed: int) -> LogEntry:
    """Another program has the hip turn at this speed, in the drive's unit; the entry of its start."""
    with leg.listen() as other:

        def write(index: int, size: int, value: int) -> None:
            head = bytes((0x2F - 4 * (size - 1),)) + index.to_bytes(2, "little") + b"\0"
            data = head + value.to_bytes(4, "little", signed=True)
            other.send(can.Message(arbitration_id=0x600 + HIP, data=data, is_extended_id=False))
            while (answer := other.recv(PATIENCE_S)) is None or answer.arbitration_id != 0x580 + HIP:
                pass
            assert answer.data[0] == 0x60

        write(0x6060, 1, PROFILE_VELOCITY)
        write(0x60FF, 4, speed)
        for word in (0x06, 0x07, 0x0F):
            write(0x6040, 2, word)
        return leg.wait_for("motion_started", HIP)


@pytest.fixture
def rig() -> Iterator[Leg]:
    with ExitStack() as undo:
        yield Leg(undo)


@pytest.fixture
def leg(rig: Leg) -> Leg:
    """A plugged-in leg."""
    rig.plug()
    return rig
