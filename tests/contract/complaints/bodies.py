"""What complaints are about: a simulated device of each kind that is not attached yet, and containers."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from math import tau
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.contract.complaints.hosts import Loopback, Wifi
from tests.support import waiting
from tests.unit.drivers.arm_rig import ArmRig
from tests.unit.drivers.attached_arm import ARM, attached
from tests.unit.drivers.conftest import Rig, call
from tests.unit.drivers.legs import COUNTS_PER_RAD, HIP, Leg
from tests.unit.drivers.motor_rig import KINDS as MOTOR_KINDS
from tests.unit.drivers.tail_rig import TailRig
from trade.errors import ConfigurationError
from trade_drivers import AttachedRobot, Motor, Robot, parse
from trade_hil_sim import (
    Arm,
    BadCrc,
    Emergency,
    HardwareFault,
    LogEntry,
    Mute,
    Place,
    Servo,
    Truncate,
    UrBus,
    WrongModel,
)

__all__ = ["KINDS", "Body", "Call", "Controllers", "outcome"]

_PATIENT = "stale_after_s = 1.0\nwatchdog_s = 1.0"
"""So that a loaded machine does not look like a fault."""
_WHILE_S = 0.3
_ATTEMPTS = 4


def outcome(act: Callable[[], object]) -> str:
    """What an act ends with: nothing, or its error in words."""
    try:
        act()
    except Exception as error:  # noqa: BLE001 - returned
        return f"{type(error).__name__}: {error}"
    return ""


class Call(threading.Thread):
    """A call in a thread of its own, with the deadline that a remote one would have."""

    def __init__(self, act: Callable[[], object]) -> None:
        super().__init__(name="caller", daemon=True)
        self._act = act
        self.ended: str | None = None
        """What it ended with; None until it has."""
        self.start()

    def run(self) -> None:
        with call(waiting.PATIENCE_S):
            self.ended = outcome(self._act)


class Ways(NamedTuple):
    """What differs between kinds of devices."""

    joint: str
    counts_per_rad: float
    bad_packet: Any
    """Some of its answers come damaged."""
    deaf: Any
    """It obeys, and does not answer."""
    overload: Any
    confuse: Callable[[Any], None]
    """Plug in what has a wrong id, or the same as another."""
    homing: tuple[int, int] = (0, 0)
    """Address and size of the register that shifts its zero."""


class Body:
    """A robot of two joints; the first one is what happens to it, and the simulator's log and truth are the judge."""

    device_id = 1

    def __init__(self, rig: Any, ways: Ways) -> None:
        self.rig, self.ways = rig, ways

    @property
    def plugged(self) -> bool:
        return hasattr(self.rig, "sim")

    def attach(self, **options: Any) -> AttachedRobot:
        """Attach the driver; on a loaded machine a simulated device may seem to be away at first."""
        if not self.plugged:
            self.rig.plug()
        for _ in range(_ATTEMPTS):
            try:
                return self.rig.attach(**options)
            except ConfigurationError as error:
                if "answer" not in str(error):
                    raise
        return self.rig.attach(**options)

    def motor(self, **options: Any) -> Motor:
        return self.attach(**options).motor(self.ways.joint)

    def strike(self, *orders: Any) -> None:
        if not self.plugged:
            self.rig.plug()
        for order in orders:
            self.rig.sim.do(order)

    def turn_by_hand(self, to_rad: float) -> None:
        if not self.plugged:
            self.rig.plug()
        truth = self.truth
        counts = truth.position_counts + round((to_rad - truth.position_rad) * self.ways.counts_per_rad)
        self.strike(Place(ids=(self.device_id,), counts=counts))
        waiting.wait_until(lambda: abs(self.truth.position_rad - to_rad) < 0.01, "it was turned")

    def shift_its_zero(self, counts: int) -> None:
        """Write its homing offset as if another program had."""
        address, size = self.ways.homing
        self.rig.sim.devices[0].write(address, counts.to_bytes(size, "little"), time.monotonic())

    @property
    def truth(self) -> Any:
        return self.rig.truth(self.device_id)

    @property
    def farthest_rad(self) -> float:
        return float(self.rig.robot.joints[0].max_rad)

    def moves(self) -> list[LogEntry]:
        """The commands it got that could move it."""
        return list(self.rig.moves()) if hasattr(self.rig, "moves") else list(self.rig.controlwords(self.device_id))

    def events(self, name: str, since: float = 0.0) -> list[LogEntry]:
        return list(self.rig.events(name, self.device_id, since))

    def wait_until_under_way(self) -> None:
        waiting.wait_until(lambda: self.truth.moving and self.truth.position_rad > 0.1, "it is under way")

    def wait_until_it_rests(self, since: float, before_rad: float) -> None:
        """Wait until it has come to rest; fails as soon as it is beyond an angle where it should have."""
        waiting.wait_until(lambda: self.events("at_rest", since) or self.truth.position_rad > before_rad, "it rests")
        assert self.truth.position_rad < before_rad, f"it continued to {self.truth.position_rad:.2f} rad"

    def wait_for_cycles(self, motor: Motor, since: float) -> None:
        """Let it be measured for a while: something that has to begin to move would have begun."""
        waiting.wait_until(lambda: motor.state().measured_at > since + _WHILE_S, "it is measured")


def _twins(rig: Rig) -> None:
    rig.plug(Servo(1), Servo(1), Servo(2))


def _other_model(rig: TailRig) -> None:
    rig.plug(prepare=lambda sim: sim.do(WrongModel(ids=(1,), number=1285)))


def _other_drive(rig: Leg) -> None:
    rig.configure(("id = 1\n", "id = 1\nserial_number = 4711\n"))
    rig.plug()
    rig.drive(HIP).store.set("serial_number", 4712)


def _dynamixel(tmp_path: Path, undo: ExitStack) -> Body:
    rig = Rig(tmp_path, undo)
    rig.configure(('driver = "dynamixel"', f'driver = "dynamixel"\n{_PATIENT}'))
    ways = Ways(
        joint="neck.pan",
        counts_per_rad=4096 / tau,
        bad_packet=BadCrc(ids=(1,), count=1),
        deaf=Mute(ids=(1,)),
        overload=HardwareFault(ids=(1,), bits=0x20),
        confuse=_twins,
        homing=(20, 4),
    )
    return Body(rig, ways)


def _feetech(tmp_path: Path, undo: ExitStack) -> Body:
    rig = TailRig(tmp_path, undo)
    rig.configure(('driver = "feetech"', f'driver = "feetech"\n{_PATIENT}'))
    ways = Ways(
        joint="tail.root",
        counts_per_rad=4096 / tau,
        bad_packet=BadCrc(ids=(1,), count=1),
        deaf=Mute(ids=(1,)),
        overload=HardwareFault(ids=(1,), bits=0x20),
        confuse=_other_model,
        homing=(31, 2),
    )
    return Body(rig, ways)


def _cia402(_: Path, undo: ExitStack) -> Body:
    rig = Leg(undo)
    rig.configure(('driver = "cia402"', f'driver = "cia402"\n{_PATIENT}'))
    ways = Ways(
        joint="leg.hip",
        counts_per_rad=COUNTS_PER_RAD,
        bad_packet=Truncate(ids=(1,), instruction="tpdo1", count=2),
        deaf=Mute(ids=(1,), instruction="sdo_reply"),
        overload=Emergency(ids=(1,), code=0x2310),
        confuse=_other_drive,
    )
    return Body(rig, ways)


def _damiao(_: Path, undo: ExitStack, *changes: tuple[str, str]) -> Body:
    rig = MOTOR_KINDS["damiao"](undo)
    before = 'watchdog_s = 0.4\nstale_after_s = 0.4\nleave = "relax"'
    rig.configure((before, f'{_PATIENT}\nleave = "hold"'), *changes)
    ways = Ways(
        joint="tail.root",
        counts_per_rad=1000,
        bad_packet=Truncate(ids=(1,), count=2),
        deaf=Mute(ids=(1,)),
        overload=HardwareFault(ids=(1,), bits=0xE),
        confuse=lambda rig: rig.plug(),
    )
    return Body(rig, ways)


class Controllers:
    """Controllers of arms, each on an address of its own, that open only some of their ports."""

    def __init__(self, undo: ExitStack) -> None:
        self._undo = undo

    def lacking(self, *services: str) -> tuple[Robot, str]:
        """One without these services: its robot file, and its address."""
        sim = self._undo.enter_context(UrBus(Arm(name="right"), name="ur", lacks=services))
        return parse(ARM.replace("192.168.0.10", str(sim.port)), "arm.toml"), str(sim.port)

    def attach(self, host: str) -> AttachedRobot:
        return attached(self._undo, host)


def _arm(_: Path, undo: ExitStack) -> ArmRig:
    rig = ArmRig(undo)
    rig.attach()
    return rig


def _with_rtde(make: Callable[[Path, ExitStack], Any]) -> Callable[[Path, ExitStack], Any]:
    def made(tmp_path: Path, undo: ExitStack) -> Any:
        pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
        return make(tmp_path, undo)

    return made


KINDS: dict[str, Callable[[Path, ExitStack], Any]] = {
    "dynamixel": _dynamixel,
    "feetech": _feetech,
    "cia402": _cia402,
    "damiao": _damiao,
    "damiao of a wide range": lambda folder, undo: _damiao(folder, undo, ("max_rad = 1.0", "max_rad = 4.2")),
    "arm": _with_rtde(_arm),
    "controllers": _with_rtde(lambda _, undo: Controllers(undo)),
    "loopback": Loopback,
    "wifi": Wifi,
    "folder": lambda tmp_path, _: tmp_path,
}
"""What makes one of each."""
