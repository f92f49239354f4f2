"""Conversion of a table of the robot file to a record, with error messages. Pure."""

import re
from collections.abc import Mapping
from math import isfinite
from typing import Final, TypeVar

import msgspec
from msgspec import Struct

_AT: Final = re.compile(r" - at `\$\.?([^`]*)`$")
_MISSING: Final = re.compile(r"missing required field `([^`]*)`")
_UNKNOWN: Final = re.compile(r"contains unknown field `([^`]*)`")
_CHOICES: Final = {"leave": '"hold" or "relax"', "process": '"shared" or "own"', "zero": '"last" or "kept"'}

_EXAMPLES: Final = {
    "port": '"/dev/serial/by-id/..." (`ls /dev/serial/by-id` shows those there are); on CAN, interface and channel',
    "driver": '"dynamixel"',
    "interface": '"socketcan"',
    "channel": '"can0"',
}


class RobotFileError(ValueError):
    """A robot file is wrong; the message says where, and what would be right."""

    def __init__(self, problem: str, where: str) -> None:
        """Make the error.

        Args:
            problem: what is wrong, and what would be right.
            where: the file, and the key if it is about one.
        """
        super().__init__(problem, where)
        self.problem: Final = problem
        self.where: Final = where

    def __str__(self) -> str:
        """File, key and problem."""
        return f"{self.where}: {self.problem}"


_Record = TypeVar("_Record", bound=Struct)


def wrong(where: str, key: str, problem: str) -> RobotFileError:
    """Returns the error that names file and key."""
    return RobotFileError(problem, f"{where}: {key}")


def record_of(key: str, name: str | None, table: Mapping[str, object], record: type[_Record], where: str) -> _Record:
    """Returns the table ``key`` as a record, with this name if it has one.

    Raises:
        RobotFileError: the table is invalid; names key, value and the valid values.
    """
    try:
        made = msgspec.convert(dict(table) if name is None else {**table, "name": name}, record)
    except msgspec.ValidationError as bad:
        raise explain(bad, table, key, record, where) from None
    _check_finite(made, key, where)
    return made


def explain(bad: Exception, table: Mapping[str, object], key: str, record: type[Struct], where: str) -> RobotFileError:
    """Returns the error for an invalid table."""
    text = str(bad)
    keys = ", ".join(name for name in record.__struct_fields__ if name != "name")
    if missing := _MISSING.search(text):
        example = _EXAMPLES.get(missing.group(1))
        hint = f"write {missing.group(1)} = {example}" if example else f"the keys are {keys}"
        return wrong(where, key, f"missing required key {missing.group(1)!r}; {hint}")
    if unknown := _UNKNOWN.search(text):
        return wrong(where, f"{key}.{unknown.group(1)}", f"unknown key; the keys are {keys}")
    at = _AT.search(text)
    field = re.split(r"[.\[]", at.group(1))[0] if at else ""
    value = table.get(field)
    if (choices := _CHOICES.get(field)) and isinstance(value, str):
        return wrong(where, f"{key}.{field}", f"must be {choices}, but it is {value!r}")
    problem = text[: at.start()] if at else text
    return wrong(where, f"{key}.{field}", f"{problem}, but it is {value!r}")


def _check_finite(record: Struct, key: str, where: str) -> None:
    """Refuses inf and nan, which TOML allows."""
    for field in record.__struct_fields__:
        value = getattr(record, field)
        if isinstance(value, float) and not isfinite(value):
            raise wrong(where, f"{key}.{field}", f"must be a finite number, but it is {value}")
