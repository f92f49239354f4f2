"""Conversion of a table of the robot file to a record, with error messages. Pure."""

import re
from collections.abc import Mapping
from math import isfinite
from typing import Final, TypeVar

import msgspec
from msgspec import Struct

from trade.errors import ConfigurationError
from trade.toml_files import mismatch

_CHOICES: Final = {"leave": '"hold" or "relax"', "process": '"shared" or "own"', "zero": '"last" or "kept"'}

_EXAMPLES: Final = {
    "port": '"/dev/serial/by-id/..." (`ls /dev/serial/by-id` shows those there are); on CAN, interface and channel',
    "driver": '"dynamixel"',
    "interface": '"socketcan"',
    "channel": '"can0"',
}

_Record = TypeVar("_Record", bound=Struct)


def wrong(where: str, key: str, problem: str) -> ConfigurationError:
    """Returns the error that names file and key."""
    return ConfigurationError(where=f"{where}: {key}", problem=problem)


def record_of(key: str, name: str | None, table: Mapping[str, object], record: type[_Record], where: str) -> _Record:
    """Returns the table ``key`` as a record, with this name if it has one.

    Raises:
        ConfigurationError: the table is invalid; names key, value and the valid values.
    """
    try:
        made = msgspec.convert(dict(table) if name is None else {**table, "name": name}, record)
    except msgspec.ValidationError as bad:
        raise explain(bad, table, key, record, where) from None
    _check_finite(made, key, where)
    return made


def explain(
    bad: msgspec.ValidationError, table: Mapping[str, object], key: str, record: type[Struct], where: str
) -> ConfigurationError:
    """Returns the error for an invalid table."""
    found = mismatch(bad)
    keys = ", ".join(name for name in record.__struct_fields__ if name != "name")
    if found.missing:
        example = _EXAMPLES.get(found.missing)
        hint = f"write {found.missing} = {example}" if example else f"the keys are {keys}"
        return wrong(where, key, f"missing required key {found.missing!r}; {hint}")
    if found.unknown:
        return wrong(where, f"{key}.{found.unknown}", f"unknown key; the keys are {keys}")
    field = re.split(r"[.\[]", found.place)[0]
    value = table.get(field)
    if (choices := _CHOICES.get(field)) and isinstance(value, str):
        return wrong(where, f"{key}.{field}", f"must be {choices}, but it is {value!r}")
    return wrong(where, f"{key}.{field}", f"{found.problem}, but it is {value!r}")


def _check_finite(record: Struct, key: str, where: str) -> None:
    """Refuses inf and nan, which TOML allows."""
    for field in record.__struct_fields__:
        value = getattr(record, field)
        if isinstance(value, float) and not isfinite(value):
            raise wrong(where, f"{key}.{field}", f"must be a finite number, but it is {value}")
