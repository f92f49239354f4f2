"""A simulated leg of two drives in this process, the driver attached to it, and the simulator's log as the judge."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import can
import pytest

from tests.support.waiting import wait_until
from trade.errors import TradeError
from trade_drivers import AttachedRobot, Motor, Robot, attach, parse
from trade_hil_sim import Entry, events, frames
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


class Leg:
    """The simulated bus and the driver attached to it: on its own adapter, or on an interface of the system."""

    def __init__(self, undo: ExitStack, interface: str = "", rate_hz: int = 20) -> None:
        self._undo = undo
        self._rate_hz = rate_hz  # on an interface
        self.interface = interface
        self.announced: list[object] = []
        self.configure()

    def configure(self, *changes: tuple[str, str]) -> None:
        """Change the robot file's text."""
        text = LEG
        for before, after in changes:
            assert before in text, before
            text = text.replace(before, after)
        if self.interface:  # where there is one slow processor, and each frame costs several calls of the system
            text = text.replace('"can0"', f'"{self.interface}"\nrate_hz = {self._rate_hz}\nstale_after_s = 1')
        self.text = text
        self.robot: Robot = parse(text, "leg.toml")

    def plug(self, *, prepare: Callable[[Cia402Bus], None] = lambda _: None, paced: bool = False) -> Cia402Bus:
        bus = self.robot.buses[0]
        joints, options = self.robot.joints_on(bus.name), {"paced": paced, "interface": self.interface}
        self.sim = Cia402Bus.from_robot(bus, joints, Path("unused"), **options)
        prepare(self.sim)
        self._undo.enter_context(self.sim)
        wait_until(lambda: {e.device_id for e in self.frames("boot_up")} >= {HIP, KNEE}, "both have booted")
        return self.sim

    def attach(self, **options: Any) -> AttachedRobot:
        """Attach the driver; it is closed with the test, whatever that says."""
        if "ports" not in options and not self.interface:  # the robot file names the interface
            options["ports"] = {"legs": self.sim.port}
        options.setdefault("register", lambda _, groups: self.announced.append(groups))
        options.setdefault("deregister", lambda _: None)
        robot = attach(self.robot, **options)
        self._undo.callback(_close, robot)
        return robot

    def listen(self) -> can.BusABC:
        """Another client of the bus."""
        if self.interface:
            return can.Bus(interface="socketcan", channel=self.interface)
        address, _, channel = self.sim.port.removeprefix("socketcand:").partition("/")
        host, _, port = address.partition(":")
        return can.Bus(interface="socketcand", host=host, port=int(port), channel=channel, tcp_tune=True)

    @property
    def log(self) -> list[Entry]:
        return list(self.sim.log.entries)

    def frames(self, name: str | None = None, device_id: int | None = None, since: float = 0.0) -> list[Entry]:
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

    def events(self, name: str, device_id: int | None = None, since: float = 0.0) -> list[Entry]:
        return events(self.log, name, device_id=device_id, since=since)

    def wait_for(self, name: str, device_id: int | None = None, since: float = 0.0) -> Entry:
        wait_until(lambda: self.events(name, device_id, since), f"{name} of {device_id}")
        return self.events(name, device_id, since)[0]

    def truth(self, device_id: int) -> Any:
        return next(device for device in self.sim.state().devices if device.device_id == device_id)

    def drive(self, device_id: int) -> Any:
        """The simulated drive itself, to be changed before the bus is open."""
        return next(device for device in self.sim.devices if device.device_id == device_id)


def _close(robot: AttachedRobot) -> None:
    with suppress(TradeError):  # what closing says is tested where it matters
        robot.close()


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


@pytest.fixture
def rig() -> Iterator[Leg]:
    with ExitStack() as undo:
        yield Leg(undo)


@pytest.fixture
def leg(rig: Leg) -> Leg:
    """A plugged-in leg."""
    rig.plug()
    return rig
