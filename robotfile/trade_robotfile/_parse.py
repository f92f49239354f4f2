"""Reads a robot file into records."""

import codecs
import re
import sys
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import msgspec

from trade_robotfile._checks import check_links
from trade_robotfile._convert import RobotFileError, explain, record_of, wrong
from trade_robotfile._records import (
    Arm,
    Camera,
    CanBus,
    Coupled,
    Drill,
    Gripper,
    Group,
    Joint,
    Robot,
    Sensor,
    SerialBus,
    UrBus,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

_SEGMENTS: Final = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*")
_TWICE = re.compile(r"Cannot declare \('(\w+)', '([^']*)'\) twice")
"""The TOML parser's message for two tables of one name."""
_SERIAL_KEYS = ("port", "baud", "fast_sync")
_CAN_KEYS = ("interface", "channel", "bitrate")
_UR_KEYS = ("host",)
_BUSLESS = ("camera", "sensor")
_LOSSY = "udp_multicast"
_RESERVED: Final = "trade"
"""The middleware's own name."""
_OTHER_MARKS: Final = {
    codecs.BOM_UTF32_LE: "UTF-32",
    codecs.BOM_UTF32_BE: "UTF-32",
    codecs.BOM_UTF16_LE: "UTF-16",
    codecs.BOM_UTF16_BE: "UTF-16",
}
"""Byte-order marks of what is not UTF-8. That of UTF-32 begins like that of UTF-16, so it is first."""


def load(path: str | PathLike[str]) -> Robot:
    """Reads and checks a robot file.

    Raises:
        RobotFileError: the file cannot be read or is invalid; the message names file, key and remedy.
    """
    where = str(path)
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise RobotFileError("there is no such file", where) from None
    except IsADirectoryError:
        raise RobotFileError("is a directory; name the robot file in it", where) from None
    except OSError as bad:
        raise RobotFileError(f"cannot be read: {bad.strerror}", where) from None
    return parse(_text_of(data, where), where)


def parse(text: str, where: str) -> Robot:
    """Parses the text of a robot file.

    Args:
        text: the TOML.
        where: the file's name, for messages.

    Raises:
        RobotFileError: the text is invalid; names file, key, value and the valid values.
    """
    raw = _toml(text, where)
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
    check_links(robot)
    return robot


def _text_of(data: bytes, where: str) -> str:
    for mark, name in _OTHER_MARKS.items():
        if data.startswith(mark):
            problem = f"is not UTF-8 text (byte 0: it has the byte-order mark of {name}; save it as UTF-8)"
            raise RobotFileError(problem, where)
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as bad:
        raise RobotFileError(f"is not UTF-8 text (byte {bad.start}: {bad.reason})", where) from None


def _toml(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    except RecursionError:
        raise RobotFileError("not valid TOML: it is nested too deeply", where) from None
    except ValueError as bad:
        message = _TWICE.sub(r'there are two of the name [\1."\2"]', str(bad))
        raise RobotFileError(f"not valid TOML: {message}", where) from None


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
    if name.split(".", maxsplit=1)[0] == _RESERVED:
        raise wrong(where, "robot.name", f"{name!r} is the middleware's own; name the robot otherwise")
    return name


def _check_name(name: str, where: str) -> None:
    if not _SEGMENTS.fullmatch(name):
        problem = f"{name!r} is no name; use lower-case words joined by dots, such as neck.pan"
        raise RobotFileError(problem, where)


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
