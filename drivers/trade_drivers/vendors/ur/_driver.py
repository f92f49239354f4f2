"""The driver of a controller and its arm, and the identification of an arm, by queries only."""

import re
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Final, NoReturn

from msgspec import structs

import trade_robotfile
from trade.errors import ConfigurationError, DeviceAbsent
from trade_drivers.bus._host_lock import HostLock, Taken
from trade_drivers.bus._jobs import PortLost
from trade_drivers.bus._thread import BusThread
from trade_drivers.commissioning._commissioner import ScannedDevice
from trade_drivers.interfaces._arm import Arm
from trade_drivers.interfaces._motion import JointGroup, Motor
from trade_drivers.plugins._driver import AttachedBus, Driver, ThreadedBus
from trade_drivers.vendors.ur._arm import UrArm
from trade_drivers.vendors.ur._arm_state import ArmStatus
from trade_drivers.vendors.ur._dashboard import DashboardError, ask, is_commanded, probe
from trade_drivers.vendors.ur._exchange import Exchange
from trade_drivers.vendors.ur._link import Link
from trade_robotfile import Bus, Robot, UrBus

_CYCLES_HZ: Final = {
    "UR3": 125.0,
    "UR5": 125.0,
    "UR10": 125.0,
    "UR3e": 500.0,
    "UR5e": 500.0,
    "UR10e": 500.0,
    "UR16e": 500.0,
}
"""Models of the CB3 and of the e-Series, with the cycles per second of their controllers."""
_ASK_S: Final = 1.0
_IDENTIFY_S: Final = 2.0
_RELEASED_WITHIN_S: Final = 2.0
_AGAIN_S: Final = 0.1
_VERSION: Final = re.compile(r"(\d+)\.\d+(?:\.\d+)*")
_E_SERIES: Final = 5
"""First digit of the e-Series' software version; the CB3's is 3."""


class AttachedController(ThreadedBus[Exchange]):
    """A controller with its arm and its owner thread."""

    def __init__(self, thread: BusThread[Exchange], link: Link, lock: HostLock) -> None:
        super().__init__(thread)
        self._link, self._lock = link, lock

    def motor(self, joint: str) -> Motor:
        raise ConfigurationError(where=f'joint."{joint}"', problem="driver ur has no joints, only an arm: [arm.NAME]")

    def group(self, name: str, joints: Sequence[str]) -> JointGroup:
        raise ConfigurationError(where=name, problem=f"driver ur has no joints such as {', '.join(joints)}")

    def arm(self, name: str) -> Arm:  # noqa: ARG002 - there is one
        return UrArm(self._thread, self._thread.exchange.limb)

    def close(self) -> None:
        try:
            super().close()
        finally:
            self._link.wait_closed()
            self._lock.release()


class UrDriver(Driver):
    """Arms of Universal Robots, through ur-rtde.

    In a robot file::

        [bus.ur]
        driver = "ur"
        host = "192.168.0.10"

        [arm.right]
        bus = "ur"
        model = "UR5e"
        min_rad = [-3.1, -3.1, -2.8, -3.1, -3.1, -3.1]
        max_rad = [3.1, 0.1, 2.8, 3.1, 3.1, 3.1]
        max_speed_rad_s = 1.0
        max_accel_rad_s2 = 2.5
        max_speed_m_s = 0.5
        max_accel_m_s2 = 1.2
    """

    modules = ("rtde_control", "rtde_receive", "rtde_io")
    own_clock = "its library ur-rtde is in C++, waits by itself, and runs in processes of its own"

    devices = (trade_robotfile.Arm,)

    def check(self, robot: Robot, bus: Bus) -> None:
        self._limb_of(robot, bus, bus.name)

    def _limb_of(self, robot: Robot, bus: Bus, port: str) -> tuple[ArmStatus, UrBus]:
        """Checks the robot file."""
        if not isinstance(bus, UrBus):
            _wrong(f"{robot.where}: bus.{bus.name}", 'driver ur needs a controller: host = "192.168.0.10"')
        if missing := self.missing():
            problem = (
                f'needs ur-rtde ({missing[0]} is missing); pip install "trade-drivers[ur]", or on platforms without'
            )
            _wrong("driver ur", f"{problem} its wheel (all but Linux x86_64 with Python 3.10-3.12) build ur-rtde 1.6.5")
        limb = _limb(robot, bus, port)
        return limb, structs.replace(bus, rate_hz=bus.rate_hz or _CYCLES_HZ[limb.arm.model])

    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        where = f"{robot.where}: bus.{bus.name}"
        limb, bus = self._limb_of(robot, bus, port)
        link, lock = Link(port), HostLock(f"ur:{port}", where)
        with ExitStack() as undo:
            try:
                lock.take()
            except Taken as taken:
                _wrong(f"{where}.host", f"{port}: another driver of this host has it: {taken}; stop it first")
            undo.callback(lock.release)
            undo.callback(link.wait_closed)
            undo.callback(link.close)
            try:
                link.wait_open()
                _refuse_company(port, where)
                _verify_model(limb, f"{robot.where}: arm.{limb.arm.name}")
            except (PortLost, DashboardError) as problem:
                raise DeviceAbsent(where=f"{where}.host", problem=str(problem)) from None
            exchange = Exchange(link, bus, limb)
            exchange.listen()
            _stop_if_moving(exchange)
            thread = BusThread(exchange, link, bus, healthy, name=f"bus {robot.name}.{bus.name}")
            thread.start()
            undo.pop_all()
        return AttachedController(thread, link, lock)


def _limb(robot: Robot, bus: UrBus, port: str) -> ArmStatus:
    arms = robot.arms_on(bus.name)
    if len(arms) != 1 or robot.joints_on(bus.name) or robot.grippers_on(bus.name):
        _wrong(f"{robot.where}: bus.{bus.name}", "a controller has one arm, and nothing else: [arm.NAME]")
    [arm] = arms
    if arm.model not in _CYCLES_HZ:
        problem = f"{arm.model!r} is unknown to the driver ur; it knows {', '.join(_CYCLES_HZ)}"
        _wrong(f"{robot.where}: arm.{arm.name}.model", problem)
    if bus.rate_hz > _CYCLES_HZ[arm.model]:
        problem = f"{bus.rate_hz:g} is more than the {_CYCLES_HZ[arm.model]:g} cycles a second of a {arm.model}"
        _wrong(f"{robot.where}: bus.{bus.name}.rate_hz", problem)
    if bus.leave != "hold":
        _wrong(f"{robot.where}: bus.{bus.name}.leave", '"relax" is nothing an arm can: it would fall; use "hold"')
    return ArmStatus(f"{robot.name}.{arm.name}", port, arm)


def _refuse_company(port: str, where: str) -> None:
    """Refuses an arm that another program controls; a killed process keeps control for a short time."""
    until = time.monotonic() + _RELEASED_WITHIN_S
    while is_commanded(port, _ASK_S):
        if time.monotonic() > until:
            _wrong(f"{where}.host", f"{port}: another program has control of this arm; stop it first")
        time.sleep(_AGAIN_S)


def _verify_model(limb: ArmStatus, where: str) -> None:
    """Checks that it is the arm of the robot file; commands nothing."""
    answer = ask(limb.bus, "get robot model", _ASK_S)
    if answer.rstrip("e").upper() != limb.arm.model.rstrip("e").upper():
        _wrong(f"{where}.model", f"the controller at {limb.bus} has a {answer}, not a {limb.arm.model}")


def _stop_if_moving(exchange: Exchange) -> None:
    """Stops a motion that no client owns (S18)."""
    if exchange.limb.still == 0:
        ask(exchange.limb.bus, "stop", _ASK_S)


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)


def identify(host: str) -> ScannedDevice:
    """Returns a controller's arm: model, software version, serial number.

    Raises:
        ConfigurationError: nothing answers, or it is not a controller.
    """
    try:
        probe(host, _IDENTIFY_S)
        model = ask(host, "get robot model", _IDENTIFY_S)
        version = _VERSION.search(ask(host, "PolyscopeVersion", _IDENTIFY_S))
        serial_number = ask(host, "get serial number", _IDENTIFY_S)
    except DashboardError as bad:
        raise ConfigurationError(where=host, problem=f"no controller of an arm answers: {bad}") from None
    e_series = version is not None and int(version[1]) >= _E_SERIES
    return ScannedDevice(
        driver="ur",
        kind="arm",
        model=f"{model.rstrip('e')}e" if e_series else model,
        firmware=version[0] if version else "",
        serial_number=int(serial_number) if serial_number.isdecimal() else None,
    )
