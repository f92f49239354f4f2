"""Attaches a robot file: opens all buses first, then announces their services; close() undoes both."""

import atexit
import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Final, TypeVar

import trade
import trade_robotfile
from trade import Container, Measure
from trade.default_system import take_over
from trade.errors import ConfigurationError, TradeError
from trade.protocol.messages import HEALTHY
from trade_drivers._metrics import measures_of
from trade_drivers._robot_file import robot_file_errors
from trade_drivers.bus._angle_store import AngleStore
from trade_drivers.bus._can_monitor import CanMonitor
from trade_drivers.faults import FaultLog, FaultPoller, FaultStore
from trade_drivers.faults._fault_poller import Health
from trade_drivers.interfaces._arm import Arm
from trade_drivers.interfaces._motion import Gripper, JointGroup, Motor
from trade_drivers.interfaces._sensing import Camera, Sensor
from trade_drivers.joints._multi_bus_group import AcrossGroup
from trade_drivers.plugins._driver import AttachedBus, Driver, SenseDriver, load_driver
from trade_drivers.plugins._validate import check
from trade_robotfile import Group, Robot

_log = logging.getLogger("trade")
_FAULTS: Final = "faults"

Provider = Motor | JointGroup | Gripper | Arm | Camera | Sensor | CanMonitor
_Sense = TypeVar("_Sense", Camera, Sensor)
_Provider = TypeVar("_Provider", Motor, JointGroup, Gripper, Arm, Camera, Sensor)


class AttachedRobot:
    """A robot with attached devices and announced services, until it is closed."""

    def __init__(
        self,
        robot: Robot,
        providers: Mapping[str, Provider],
        buses: Mapping[str, AttachedBus],
        faults: FaultLog,
        undo: ExitStack,
    ) -> None:
        self.robot = robot
        self.faults = faults
        """Current and past faults of the robot's devices; the provider in group ``rosie.faults``."""
        self._buses = buses
        self.providers = dict(providers)
        """Providers by group: ``rosie.neck.pan`` -> a Motor, ``rosie.head`` -> a JointGroup, ``rosie.left.hand`` -> a
        Gripper, ``rosie.right`` -> an Arm, ``rosie.eye`` -> a Camera, ``rosie.wrist`` -> a Sensor, ``rosie.bus.legs``
        -> a CanMonitor."""
        self._undo = undo
        self._lock = threading.Lock()
        atexit.register(self.close)

    def motor(self, joint: str) -> Motor:
        """Returns the provider of a joint by its name in the robot file; raises KeyError if there is none."""
        return self._provider(joint, Motor)

    def group(self, name: str) -> JointGroup:
        """Returns the provider of a group by its name in the robot file; raises KeyError if there is none."""
        return self._provider(name, JointGroup)

    def gripper(self, name: str) -> Gripper:
        """Returns the provider of a gripper by its name in the robot file; raises KeyError if there is none."""
        return self._provider(name, Gripper)

    def arm(self, name: str) -> Arm:
        """Returns the provider of an arm by its name in the robot file; raises KeyError if there is none."""
        return self._provider(name, Arm)

    def camera(self, name: str) -> Camera:
        """Returns the provider of a camera by its name in the robot file; raises KeyError if there is none."""
        return self._provider(name, Camera)

    def sensor(self, name: str) -> Sensor:
        """Returns the provider of a sensor by its name in the robot file; raises KeyError if there is none."""
        return self._provider(name, Sensor)

    def monitor(self, bus: str) -> CanMonitor:
        """Returns the provider of a CAN bus by its name in the robot file; raises KeyError if there is none."""
        provider = self.providers[_bus_group(self.robot, bus)]
        if not isinstance(provider, CanMonitor):
            raise KeyError(bus)
        return provider

    def measures(self) -> Iterator[Measure]:
        """Yields metrics of buses and joints for `trade.Container.measured_by`, without a request to any device."""
        return measures_of(self.robot, self._buses, self.providers)

    def unseen(self) -> list[str]:
        """After close(): returns the devices that were not seen at rest when the driver left them. Check them."""
        return [name for bus in self._buses.values() for name in bus.unseen()]

    def _provider(self, name: str, type_: type[_Provider]) -> _Provider:
        provider = self.providers[f"{self.robot.name}.{name}"]
        if not isinstance(provider, type_):
            raise KeyError(name)
        return provider

    def close(self) -> None:
        """Withdraws the services, stops all motion, and leaves each device as the robot file says. Idempotent.

        Raises:
            TradeError: a device could not be left as the file says; everything is closed nevertheless.
        """
        atexit.unregister(self.close)
        with self._lock:
            self._undo.close()

    def __enter__(self) -> "AttachedRobot":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _always() -> bool:
    return True


def attach(
    robot: Robot,
    container: Container | None = None,
    *,
    announced: bool = True,
    ports: Mapping[str, str] | None = None,
) -> AttachedRobot:
    """Attaches all devices of a robot, then announces their services. Moves and enables nothing; stops what moves.

    Joint ``neck.pan`` of robot ``rosie`` becomes a Motor in group ``rosie.neck.pan``, group ``head`` a JointGroup in
    ``rosie.head``, whether its joints share a bus or not, gripper ``left.hand`` a Gripper in ``rosie.left.hand``, arm
    ``right`` an Arm in ``rosie.right``, camera ``eye`` a Camera in ``rosie.eye``, sensor ``wrist`` a Sensor in
    ``rosie.wrist``, CAN bus ``legs`` a CanMonitor in ``rosie.bus.legs``. ``rosie.faults`` reports the faults of all of
    them. If anything is wrong, nothing is announced and every port is freed.

    Args:
        robot: the result of ``load``.
        container: announces the services and their health; by default the default container. Each bus thread asks in
            each cycle whether it is healthy: while it is not, or is closed, devices are commanded to hold once and the
            bus is silent, so that their own watchdogs stop them. Faults and last known angles outlive the process in
            its state folder; a bus with a port from ``ports`` saves no angles.
        announced: False: only this program uses the devices; nothing is announced or saved, and no container starts.
        ports: replacements for the ports in the file, for simulated devices. Bus name -> serial device, or
            ``INTERFACE:CHANNEL`` of a CAN bus; camera or sensor name -> its driver's kind of port.

    Raises:
        ConfigurationError: a driver is missing, a port cannot be opened, or a device is absent, another or set wrongly.
    """
    with ExitStack() as undo:
        _check_ports(robot, ports or {})
        check(robot, ports)
        home = (container or trade.container()) if announced else None
        state_dir = None if home is None else _state_dir(home)
        faults = _fault_log(robot, state_dir, undo)
        name = f"faults of {robot.name}"
        poller = FaultPoller(faults, name) if home is None else FaultPoller(faults, name, home.set_health)
        undo.callback(poller.close)  # closes after the devices, to record faults during their shutdown, too
        senses = _attach_senses(robot, ports or {}, undo)  # first: if one is missing, no moving device is accessed
        angles = _angle_store(robot, state_dir, undo)
        buses = _attach_buses(robot, ports or {}, _always if home is None else home.healthy, undo)
        for name, bus in buses.items():
            if angles is not None and name not in (ports or {}):
                bus.remember(angles)
        providers = _providers(robot, buses, senses)
        healths = {} if home is None else _healths(robot, providers, faults)
        poller.start(providers, _unwatched(robot, buses, poller), healths)
        if home is not None:
            for name, provider in {**providers, f"{robot.name}.{_FAULTS}": faults}.items():
                home.register(provider, (name,))
                undo.callback(_withdraw, home, provider)
        return AttachedRobot(robot, providers, buses, faults, undo.pop_all())


def _state_dir(container: Container) -> Path | None:
    settings = container.settings
    return None if settings.state_dir is None else settings.state_dir / settings.system


def _fault_log(robot: Robot, state_dir: Path | None, undo: ExitStack) -> FaultLog:
    path = None if state_dir is None else state_dir / "faults" / f"{robot.name}.sqlite"
    parts = (*robot.joints, *robot.grippers, *robot.arms, *robot.cameras, *robot.sensors, *robot.groups)
    names = [
        f"{robot.name}.{name}" for name in (*(part.name for part in parts), *(f"bus.{b.name}" for b in robot.buses))
    ]
    log = FaultLog(robot.name, None if path is None else FaultStore(path, _log.warning), devices=names)
    undo.callback(log.close)
    return log


def _angle_store(robot: Robot, state_dir: Path | None, undo: ExitStack) -> AngleStore | None:
    if state_dir is None or not robot.joints:
        return None
    try:
        take_over(state_dir, f"angles/{robot.name}.sqlite")
    except OSError as bad:
        _log.warning("the last known angles of an earlier name of this system cannot be copied: %s", bad)
    angles = AngleStore(state_dir / "angles" / f"{robot.name}.sqlite", _log.warning)
    undo.callback(angles.close)  # closes after the buses, to save where they left their joints, too
    angles.load()  # what is wrong in it is said before a bus is opened
    return angles


def _unwatched(robot: Robot, buses: Mapping[str, AttachedBus], poller: FaultPoller) -> set[str]:
    """Subscribes to the faults that buses report; returns the names of the devices whose bus reports none."""
    deaf = {name for name, bus in buses.items() if not bus.watched(poller.tell)}
    moving = (*robot.joints, *robot.grippers, *robot.arms)
    names = [*(device.name for device in moving if device.bus in deaf), *(sensor.name for sensor in robot.sensors)]
    return {f"{robot.name}.{name}" for name in names}


def _check_ports(robot: Robot, ports: Mapping[str, str]) -> None:
    names = [device.name for device in (*robot.buses, *robot.cameras, *robot.sensors)]
    if unknown := sorted(set(ports) - set(names)):
        problem = f"there is no bus {unknown[0]!r} to give a port to; known: {', '.join(names)}"
        raise ConfigurationError(where=robot.where, problem=problem)


def _attach_senses(robot: Robot, ports: Mapping[str, str], undo: ExitStack) -> dict[str, Camera | Sensor]:
    return {
        **{f"{robot.name}.{each.name}": _sense(robot, each, Camera, ports, undo) for each in robot.cameras},
        **{f"{robot.name}.{each.name}": _sense(robot, each, Sensor, ports, undo) for each in robot.sensors},
    }


def _sense(
    robot: Robot,
    device: trade_robotfile.Camera | trade_robotfile.Sensor,
    wanted: type[_Sense],
    ports: Mapping[str, str],
    undo: ExitStack,
) -> _Sense:
    where = f"{robot.where}: {device.key}.driver"
    driver = load_driver(device.driver, where, SenseDriver)
    with robot_file_errors():
        sense = driver.attach(f"{robot.name}.{device.name}", device, ports.get(device.name))
    undo.callback(sense.close)
    if not isinstance(sense, wanted):
        raise ConfigurationError(where=where, problem=f"driver {device.driver!r} has no {wanted.__name__.lower()}s")
    return sense


def _attach_buses(
    robot: Robot, ports: Mapping[str, str], healthy: Callable[[], bool], undo: ExitStack
) -> dict[str, AttachedBus]:
    used = {device.bus for device in (*robot.joints, *robot.grippers, *robot.arms)}
    buses: dict[str, AttachedBus] = {}
    for bus in robot.buses:
        driver = load_driver(bus.driver, f"{robot.where}: bus.{bus.name}.driver", Driver)
        if bus.name in used:
            buses[bus.name] = driver.attach(robot, bus, ports.get(bus.name, bus.port), healthy)
            undo.callback(buses[bus.name].close)
    return buses


def _providers(
    robot: Robot, buses: Mapping[str, AttachedBus], senses: Mapping[str, Camera | Sensor]
) -> dict[str, Provider]:
    providers: dict[str, Motor | JointGroup | Gripper | Arm] = {
        f"{robot.name}.{joint.name}": buses[joint.bus].motor(joint.name) for joint in robot.joints
    }
    for gripper in robot.grippers:
        providers[f"{robot.name}.{gripper.name}"] = buses[gripper.bus].gripper(gripper.name)
    for arm in robot.arms:
        providers[f"{robot.name}.{arm.name}"] = buses[arm.bus].arm(arm.name)
    for group in robot.groups:
        providers[f"{robot.name}.{group.name}"] = _group(robot, group, buses)
    members = robot.members()
    for provider in providers.values():
        provider.members = members
    return {**providers, **senses, **_monitors(robot, buses)}


def _bus_group(robot: Robot, bus: str) -> str:
    return f"{robot.name}.bus.{bus}"


def _monitors(robot: Robot, buses: Mapping[str, AttachedBus]) -> dict[str, CanMonitor]:
    named = ((name := _bus_group(robot, bus), attached.monitor(name)) for bus, attached in buses.items())
    return {name: monitor for name, monitor in named if monitor is not None}


def _healths(robot: Robot, providers: Mapping[str, Provider], faults: FaultLog) -> dict[object, list[Health]]:
    """What judges each device and group: its CAN bus, and its faults."""
    groups = {group.name: group.joints for group in robot.groups}
    bus_of = {device.name: device.bus for device in (*robot.joints, *robot.grippers, *robot.arms)}
    watched: dict[object, list[Health]] = {}
    for full, provider in providers.items():
        if isinstance(provider, CanMonitor):
            watched[provider] = [provider.health]
            continue
        name = full.removeprefix(f"{robot.name}.")
        parts = groups.get(name, [name])
        buses = dict.fromkeys(bus_of[part] for part in parts if part in bus_of)
        monitors = [providers.get(_bus_group(robot, bus)) for bus in buses]
        watched[provider] = [monitor.health for monitor in monitors if isinstance(monitor, CanMonitor)]
        watched[provider] += [_health_by(faults, f"{robot.name}.{part}", whole=name in groups) for part in parts]
    return watched


def _health_by(faults: FaultLog, device: str, *, whole: bool) -> Health:
    """Returns a function that derives the health of a device, or of a group with it, from the fault log."""

    def health() -> str:
        wrong = faults.health(device)
        return f"degraded: {f'{device}: ' if whole else ''}{wrong}" if wrong else HEALTHY

    return health


def _group(robot: Robot, group: Group, buses: Mapping[str, AttachedBus]) -> JointGroup:
    on = {joint.name: joint.bus for joint in robot.joints}
    parts: dict[str, list[str]] = {}
    for joint in group.joints:
        parts.setdefault(on[joint], []).append(joint)
    made = [buses[bus].group(f"{robot.name}.{group.name}", joints) for bus, joints in parts.items()]
    return made[0] if len(made) == 1 else AcrossGroup([f"{robot.name}.{joint}" for joint in group.joints], made)


def _withdraw(container: Container, provider: object) -> None:
    try:
        container.deregister(provider)
    except TradeError as gone:  # its container has already ended, so the provider is withdrawn
        _log.debug("withdrawing %r: %s", provider, gone)
