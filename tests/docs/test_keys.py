"""The table of keys in docs/drivers.md: each key that a robot file may have, with its default and its range."""

import re
from collections.abc import Iterator
from typing import Final

import msgspec
import pytest
from msgspec import NODEFAULT, Struct, inspect

from tests.docs.blocks import DOCS
from trade_robotfile import Arm, Bus, CanBus, Coupled, Gripper, Group, Joint, SerialBus, UrBus

RECORDS: Final[dict[str, type[Struct]]] = {
    "`[bus.NAME]`": Bus,
    "a serial one": SerialBus,
    "a CAN bus": CanBus,
    "an arm's controller": UrBus,
    "`[joint.NAME]`": Joint,
    "`[gripper.NAME]`": Gripper,
    "`[arm.NAME]`": Arm,
    "`[group.NAME]`": Group,
    "`[[coupled]]`": Coupled,
}


@pytest.mark.parametrize("table", RECORDS)
def test_each_key_is_shown_with_its_default_and_range(table: str) -> None:
    assert shown()[table] == dict(keys(RECORDS[table]))


def shown() -> dict[str, dict[str, tuple[str, str]]]:
    """The page: by table and key, default and range."""
    page = (DOCS / "drivers.md").read_text(encoding="utf-8")
    _, _, part = page.partition("| table | key | default | range | what it is |\n")
    rows = re.findall(r"^\| (.*?) ?\| `(\w+)` \| (.+?) \| (.+?) \| .*\|$", part.partition("\n\n")[0], re.MULTILINE)
    found: dict[str, dict[str, tuple[str, str]]] = {}
    table = ""
    for heading, key, default, range_ in rows:
        table = heading or table
        found.setdefault(table, {})[key] = (default, range_)
    return found


def keys(record: type[Struct]) -> Iterator[tuple[str, tuple[str, str]]]:
    """The record that is read: what it does not have from every bus."""
    common = dict(_fields(Bus)) if record is not Bus and issubclass(record, Bus) else {}
    for key, reported in _fields(record):
        if key != "name" and common.get(key) != reported:
            yield key, reported


def _fields(record: type[Struct]) -> Iterator[tuple[str, tuple[str, str]]]:
    about = inspect.type_info(record)
    assert isinstance(about, inspect.StructType)
    for field in about.fields:
        yield field.name, ("**required**" if field.required else _default(field.default), _range(field.type))


def _default(value: object) -> str:
    if value is None or value is NODEFAULT:
        return "none"
    if isinstance(value, bool | str):
        return msgspec.json.encode(value).decode()
    assert isinstance(value, int | float)
    return _number(value)


def _range(kind: inspect.Type) -> str:
    match kind:
        case inspect.UnionType(types=(only, inspect.NoneType())):
            return _range(only)
        case inspect.StrType():
            return "text"
        case inspect.BoolType():
            return "true, false"
        case inspect.LiteralType(values=values):
            return ", ".join(f'"{value}"' for value in values)
        case inspect.ListType(min_length=least, max_length=most):
            return f"a list of {most}" if most else f"a list of {least} or more" if (least or 0) > 1 else "a list"
        case inspect.DictType():
            return "a table"
        case inspect.IntType() | inspect.FloatType():
            low = None if kind.ge is None else _number(kind.ge)
            low = low if kind.gt is None else f"above {_number(kind.gt)}"
            if kind.le is not None:
                return f"{low} to {_number(kind.le)}"
            return "any" if low is None else low if kind.gt is not None else f"{low} or more"
        case _:
            raise AssertionError(kind)


def _number(value: float) -> str:
    return f"{value:,.10g}".replace(",", " ")
