"""The robot file: a robot's devices, their buses and their limits. Pure records, no I/O.

It has over 400 lines, since the checks of a file need all of its records.
"""

import re
from collections.abc import Mapping
from typing import Annotated, Literal, TypeVar, cast

import msgspec
from msgspec import Meta, Struct

from trade._protocol.keys import DOMAIN
from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade.toml_files import read_toml_text
from trade_drivers.robotfile._convert import explain, record_of, wrong
from trade_drivers.robotfile._records import Arm, Camera, Coupled, Drill, Gripper, Group, Positive, Sensor, arm_problem

__all__ = [
    "Arm",
    "Bus",
    "Camera",
    "CanBus",
    "Coupled",
    "Drill",
    "Gripper",
    "Group",
    "Joint",
    "Robot",
    "Sensor",
    "SerialBus",
    "UrBus",
    "parse",
    "read_text",
]

_SEGMENTS = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*")
_TWICE = re.compile(r"Cannot declare \('(\w+)', '([^']*)'\) twice")
"""The TOML parser's message for two tables of one name."""
_SERIAL_KEYS = ("port", "baud", "fast_sync")
_CAN_KEYS = ("interface", "channel", "bitrate")
_UR_KEYS = ("host",)
_BUSLESS = ("camera", "sensor")
_LOSSY = "udp_multicast"

Text = Annotated[str, Meta(min_length=1)]


class Bus(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One bus: the settings of all kinds of buses."""

    name: str
    driver: str
    """Entry point of the group ``trade.drivers``: ``dynamixel``."""
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 100.0
    """Cycles of reading and writing per second."""
    stale_after_s: Annotated[float, Meta(gt=0, le=2)] = 0.25
    """The age from which a measurement is an error."""
    watchdog_s: Annotated[float, Meta(ge=0.1, le=2)] = 0.3
    """The timeout of the device's own watchdog. A device without one is never commanded farther ahead than this."""
    leave: Literal["hold", "relax"] = "hold"
    """What the driver does with enabled devices at shutdown: hold the position, or switch torque off."""
    process: Literal["shared", "own"] = "shared"
    """Whether ``trade up`` runs it in the robot's process, or in one of its own that no other bus or code delays."""


class SerialBus(Bus, frozen=True, kw_only=True):
    """A serial line."""

    port: Text
    """Serial device; prefer the stable name under /dev/serial/by-id."""
    baud: Annotated[int, Meta(ge=9600, le=4_500_000)] = 1_000_000
    fast_sync: bool = False
    """Read all devices with one combined answer (needs firmware support)."""


class CanBus(Bus, frozen=True, kw_only=True):
    """A CAN bus, with the names of python-can."""

    interface: Annotated[str, Meta(pattern="^[a-z0-9_]+$")]
    """``socketcan``, ``socketcand``, ``slcan``, ``virtual`` or another one of python-can except ``udp_multicast``."""
    channel: Text
    """``can0`` for socketcan, ``HOST:PORT/can0`` for socketcand, the serial device for slcan."""
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)] = 1_000_000
    """Bits per second. Must match the rate that the operating system sets for its own interfaces."""

    @property
    def port(self) -> str:
        """Interface and channel as one text, such as ``socketcan:can0``."""
        return f"{self.interface}:{self.channel}"


class UrBus(Bus, frozen=True, kw_only=True):
    """The controller of a Universal Robots arm, on the network."""

    host: Text
    """Host name or address; the ports are fixed."""
    rate_hz: Annotated[float, Meta(ge=0, le=500)] = 0.0
    """Set-points per second; 0: one per cycle of the controller, 500 or (CB3) 125."""

    @property
    def port(self) -> str:
        """The host."""
        return self.host


class Joint(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One joint: its device on a bus, its zero and its limits."""

    name: str
    bus: str
    id: Annotated[int, Meta(ge=0, le=252)]
    model: str
    """Model as printed on the device: ``XL430-W250``."""
    firmware: str | None = None
    """Firmware version that the device must report. Not checked if left out."""
    serial_number: Annotated[int, Meta(ge=0)] | None = None
    """Serial number that the device must report. Not checked if left out."""
    reversed: bool = False
    homing_counts: int = 0
    """The servo's homing offset at calibration. Another one is refused, as the zero has moved."""
    offset_rad: float = 0.0
    """Joint angle when the device reads its centre, or 0 where counts have no centre."""
    counts_per_rev: Positive | None = None
    """Encoder counts per turn of the motor, for devices whose model does not determine them."""
    gear: Positive = 1.0
    """Turns of the motor per turn of the joint."""
    zero: Literal["last", "kept"] | None = None
    """How its zero is known after a loss of power: by its last known angle, or because the device keeps or finds it."""
    min_rad: float
    max_rad: float
    max_speed_rad_s: Positive
    max_accel_rad_s2: Positive


class Robot(Struct, frozen=True, kw_only=True):
    """A parsed and checked robot file."""

    name: str
    buses: list[SerialBus | CanBus | UrBus]
    joints: list[Joint]
    groups: list[Group]
    coupled: list[Coupled]
    where: str
    """The file the robot was read from."""
    grippers: list[Gripper] = []
    arms: list[Arm] = []
    cameras: list[Camera] = []
    sensors: list[Sensor] = []
    drill: Drill = Drill()
    given: dict[str, list[str]] = {}
    """The keys in each bus's table, so that a driver can refuse those it does not use."""

    def joints_on(self, bus: str) -> list[Joint]:
        """Returns the joints on one bus, in file order."""
        return [joint for joint in self.joints if joint.bus == bus]

    def grippers_on(self, bus: str) -> list[Gripper]:
        """Returns the grippers on one bus, in file order."""
        return [gripper for gripper in self.grippers if gripper.bus == bus]

    def arms_on(self, bus: str) -> list[Arm]:
        """Returns the arms on one bus, in file order."""
        return [arm for arm in self.arms if arm.bus == bus]

    def own_processes(self) -> list[str]:
        """Returns the buses that need a process besides the one for the rest of the robot.

        If each bus with a device has a process of its own, the first one is the rest.
        """
        devices = (*self.joints, *self.grippers, *self.arms)
        used = {device.bus for device in devices}
        own = [bus.name for bus in self.buses if bus.process == "own" and bus.name in used]
        shared = used.difference(own) or self.cameras or self.sensors
        return own if shared else own[1:]

    def coupled_to(self, joint: str) -> list[str]:
        """Returns the full names of the joints that are only locked together with this one."""
        names = dict.fromkeys(name for pair in self.coupled if joint in pair.joints for name in pair.joints)
        return [f"{self.name}.{name}" for name in names if name != joint]

    def members(self) -> dict[str, list[str]]:
        """Returns the devices of the robot, of its groups and of each prefix of their names, with full names.

        A lock of one of these covers all of its members, or none.
        """
        found: dict[str, dict[str, None]] = {}
        for device in (*self.joints, *self.grippers, *self.arms):
            full = f"{self.name}.{device.name}"
            for end, letter in enumerate(full):
                if letter == ".":
                    found.setdefault(full[:end], {})[full] = None
        for group in self.groups:
            joints = found.setdefault(f"{self.name}.{group.name}", {})
            joints.update(dict.fromkeys(f"{self.name}.{joint}" for joint in group.joints))
        return {group: list(joints) for group, joints in found.items()}


def parse(text: str, where: str) -> Robot:
    """Parses the text of a robot file.

    Args:
        text: the TOML.
        where: the file's name, for messages.

    Raises:
        ConfigurationError: the text is invalid; names file, key, value and the valid values.
    """
    try:
        raw = read_toml_text(text)
    except ValueError as bad:
        message = _TWICE.sub(r'there are two of the name [\1."\2"]', str(bad))
        raise ConfigurationError(where=where, problem=f"not valid TOML: {message}") from None
    _only_known(raw, where)
    name = _robot_name(raw.get("robot"), where)
    buses = _tables(raw, "bus", where)
    robot = Robot(
        name=name,
        buses=[_bus(*entry, where) for entry in buses],
        joints=[record_of(*entry, Joint, where) for entry in _tables(raw, "joint", where)],
        grippers=[record_of(*entry, Gripper, where) for entry in _tables(raw, "gripper", where)],
        arms=[record_of(*entry, Arm, where) for entry in _tables(raw, "arm", where)],
        cameras=[_sense(*entry, Camera, where) for entry in _tables(raw, "camera", where)],
        sensors=[_sense(*entry, Sensor, where) for entry in _tables(raw, "sensor", where)],
        groups=[record_of(*entry, Group, where) for entry in _tables(raw, "group", where)],
        coupled=_coupled(raw.get("coupled", []), where),
        drill=_drill(raw.get("drill", {}), where),
        where=where,
        given={name: list(table) for _, name, table in buses},
    )
    _check_links(robot)
    return robot


def _only_known(raw: Mapping[str, object], where: str) -> None:
    sections = ("robot", "bus", "joint", "gripper", "arm", "camera", "sensor", "group", "drill")
    known = {key: f"[{key}]" for key in sections} | {"coupled": "[[coupled]]"}
    for key in raw:
        if key not in known:
            raise wrong(where, f"[{key}]", f"unknown table; a robot file has {', '.join(known.values())}")


def _robot_name(table: object, where: str) -> str:
    if not isinstance(table, dict) or not isinstance(table.get("name"), str):  # pyright: ignore[reportUnknownMemberType]
        raise wrong(where, "[robot]", 'missing; write [robot] and name = "rosie"')
    extra: list[str] = [str(key) for key in table if key != "name"]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    if extra:
        raise wrong(where, f"robot.{extra[0]}", "unknown key; [robot] has only name")
    name = str(table["name"])  # pyright: ignore[reportUnknownArgumentType]
    _check_name(name, f"{where}: robot.name")
    if name.split(".", maxsplit=1)[0] == DOMAIN:
        raise wrong(where, "robot.name", f"{name!r} is the middleware's own; name the robot otherwise")
    return name


def _check_name(name: str, where: str) -> None:
    if not _SEGMENTS.fullmatch(name):
        problem = f"{name!r} is no name; use lower-case words joined by dots, such as neck.pan"
        raise ConfigurationError(where=where, problem=problem)


def _tables(raw: Mapping[str, object], section: str, where: str) -> list[tuple[str, str, Mapping[str, object]]]:
    """Returns the tables of a section, each with its key for messages, its name and its contents."""
    tables = raw.get(section, {})
    if not isinstance(tables, dict):
        raise wrong(where, section, f"must be tables: [{section}.NAME]")
    if not tables and section == "bus" and raw.keys().isdisjoint(_BUSLESS):
        raise wrong(where, f"[{section}.NAME]", "missing; a robot needs at least one")
    return [_table(section, str(name), table, where) for name, table in tables.items()]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]


def _table(section: str, name: str, table: object, where: str) -> tuple[str, str, Mapping[str, object]]:
    key = f'{section}."{name}"' if "." in name else f"{section}.{name}"
    _check_name(name, f"{where}: {key}")
    if not isinstance(table, dict):
        raise wrong(where, key, f"must be a table: [{key}]")
    if any(isinstance(value, dict) and key != "poses" for key, value in table.items()):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        raise wrong(where, key, f'a dotted name needs quotes: [{section}."{name}.{next(iter(table))}"]')  # pyright: ignore[reportUnknownArgumentType]
    return key, name, cast("dict[str, object]", table)


def _bus(key: str, name: str, table: Mapping[str, object], where: str) -> SerialBus | CanBus | UrBus:
    """Returns a bus of the kind that its keys determine."""
    if any(word in table for word in _UR_KEYS):
        return record_of(key, name, table, UrBus, where)
    can = [word for word in _CAN_KEYS if word in table]
    serial = [word for word in _SERIAL_KEYS if word in table]
    if can and serial:
        problem = f"{serial[0]!r} is a key of a serial bus and {can[0]!r} one of a CAN bus; a bus is one of them"
        raise wrong(where, key, problem)
    if not can:
        return record_of(key, name, table, SerialBus, where)
    bus = record_of(key, name, table, CanBus, where)
    if bus.interface == _LOSSY:
        problem = f"{_LOSSY!r} loses frames and echoes a sender's own, which look like those of drives; use another"
        raise wrong(where, f"{key}.interface", problem)
    return bus


_Sense = TypeVar("_Sense", Camera, Sensor)


def _sense(key: str, name: str, table: Mapping[str, object], record: type[_Sense], where: str) -> _Sense:
    """Returns a camera or a sensor; its driver checks the options."""
    driver = table.get("driver")
    if not isinstance(driver, str) or not driver:
        raise wrong(where, f"{key}.driver", 'must name its driver, such as driver = "snapshot"')
    options = {option: value for option, value in table.items() if option != "driver"}
    return record(name=name, driver=driver, options=options, key=key, where=where)


def _drill(table: object, where: str) -> Drill:
    if not isinstance(table, dict):
        raise wrong(where, "drill", "must be a table: [drill]")
    return record_of("drill", None, cast("dict[str, object]", table), Drill, where)


def _coupled(tables: object, where: str) -> list[Coupled]:
    if not isinstance(tables, list):
        raise wrong(where, "coupled", "must be a list of tables, each with a heading of its own: [[coupled]]")
    made: list[Coupled] = []
    for number, table in enumerate(tables, 1):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        try:
            made.append(msgspec.convert(table, Coupled))
        except msgspec.ValidationError as bad:
            values = table if isinstance(table, dict) else {}  # pyright: ignore[reportUnknownVariableType]
            raise explain(bad, values, f"coupled {number}", Coupled, where) from None  # pyright: ignore[reportUnknownArgumentType]
    return made


def _check_links(robot: Robot) -> None:
    _check_ports(robot)
    _check_devices(robot)
    for joint in robot.joints:
        if not joint.min_rad < joint.max_rad:
            problem = f"must be greater than min_rad, but {joint.max_rad} <= {joint.min_rad}"
            raise wrong(robot.where, f'joint."{joint.name}".max_rad', problem)
    for gripper in robot.grippers:
        if not gripper.min_width_m < gripper.max_width_m:
            problem = f"must be greater than min_width_m, but {gripper.max_width_m} <= {gripper.min_width_m}"
            raise wrong(robot.where, f'gripper."{gripper.name}".max_width_m', problem)
    for arm in robot.arms:
        if (bad := arm_problem(arm)) is not None:
            raise wrong(robot.where, f'arm."{arm.name}".{bad[0]}', bad[1])
    _check_groups(robot)
    _check_taken(robot)


def _check_taken(robot: Robot) -> None:
    """Checks that no device has a name that drivers use themselves."""
    devices = (*robot.joints, *robot.grippers, *robot.arms, *robot.cameras, *robot.sensors, *robot.groups)
    taken = {"faults": "the fault log"}
    taken |= {f"bus.{bus.name}": "the bus itself" for bus in robot.buses if isinstance(bus, CanBus)}
    for device in devices:
        if (what := taken.get(device.name)) is not None:
            kind, full = type(device).__name__.lower(), f"{robot.name}.{device.name}"
            raise wrong(robot.where, f'{kind}."{device.name}"', f"{full} is {what}; name the {kind}s otherwise")


def _check_devices(robot: Robot) -> None:
    """Checks that there is a device, and that each has an existing bus, a unique id and a unique name."""
    devices = (*robot.joints, *robot.grippers, *robot.arms)
    if not (devices or robot.cameras or robot.sensors):
        problem = "missing; a robot needs at least one joint, gripper, arm, camera or sensor"
        raise wrong(robot.where, "[joint.NAME]", problem)
    buses, names, seen = {bus.name for bus in robot.buses}, set[str](), dict[tuple[str, int], str]()
    for device in devices:
        kind = type(device).__name__.lower()
        key = f'{kind}."{device.name}"'
        if device.bus not in buses:
            problem = f"there is no bus {device.bus!r}; there is {', '.join(sorted(buses)) or 'none'}"
            raise wrong(robot.where, f"{key}.bus", problem)
        number = -1 if isinstance(device, Arm) else device.id
        if other := seen.get((device.bus, number)):
            if number < 0:
                raise wrong(robot.where, f"{key}.bus", f"controller {device.bus!r} has its one arm: {other}")
            raise wrong(robot.where, f"{key}.id", f"{number} is taken on bus {device.bus!r} by {other}")
        if device.name in names:
            raise wrong(robot.where, key, "a joint has this name already")
        names.add(device.name)
        seen[device.bus, number] = f"{kind} {device.name!r}"
    for sense in (*robot.cameras, *robot.sensors):
        if sense.name in names | buses:
            raise wrong(robot.where, sense.key, "a device or a bus has this name already")
        names.add(sense.name)


def _check_ports(robot: Robot) -> None:
    owners = dict[str, str]()
    for bus in robot.buses:
        if other := owners.get(bus.port):
            raise wrong(robot.where, f"bus.{bus.name}.port", f"{bus.port} is the port of bus {other!r} already")
        owners[bus.port] = bus.name


def _check_groups(robot: Robot) -> None:
    names = {joint.name for joint in robot.joints}
    others = (*robot.grippers, *robot.arms, *robot.cameras, *robot.sensors)
    for group in robot.groups:
        _check_joints(robot, group.joints, f"group.{group.name}.joints", names)
        _check_process(robot, group.joints, f"group.{group.name}.joints")
        if group.name in names | {device.name for device in others}:
            raise wrong(robot.where, f"group.{group.name}", "a device has this name already")
    for number, coupled in enumerate(robot.coupled, 1):
        _check_joints(robot, coupled.joints, f"coupled {number}.joints", names)
        _check_process(robot, coupled.joints, f"coupled {number}.joints")


def _check_process(robot: Robot, joints: list[str], key: str) -> None:
    """Checks that joints which move or are locked together are driven by one process."""
    bus_of = {joint.name: joint.bus for joint in robot.joints}
    own = {bus.name for bus in robot.buses if bus.process == "own"}
    inside = next((joint for joint in joints if bus_of[joint] in own), None)
    if inside is None:
        return
    for joint in joints:
        if bus_of[joint] != bus_of[inside]:
            problem = (
                f"{inside} is on bus {bus_of[inside]!r} with a process of its own, and {joint} is not; "
                f'leave out process = "own", or take joints of one bus'
            )
            raise wrong(robot.where, key, problem)


def _check_joints(robot: Robot, joints: list[str], key: str, names: set[str]) -> None:
    for joint in joints:
        if joint not in names:
            raise wrong(robot.where, key, f"there is no joint {joint!r}; there is {', '.join(sorted(names))}")
    if len(set(joints)) < len(joints):
        raise wrong(robot.where, key, f"names a joint twice: {joints}")
