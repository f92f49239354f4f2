"""Results of types that the caller has no code for: decoded from their description."""

import datetime as dt
import enum
import importlib
import os
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from trade import Container, where
from trade._calls.target import result_decoder
from trade.protocol.messages import ServiceInfo
from trade.protocol.schema import schema_message
from trade.protocol.schema_types import type_from_schema

pytestmark = pytest.mark.virtual_time

PROGRAM = """
import datetime, enum
from dataclasses import dataclass
from typing import Any
import msgspec

class Mode(enum.Enum):
    SLOW = "slow"

class Pose(msgspec.Struct):
    x_m: float
    y_m: float = 0.25

@dataclass
class Reading:
    value: float
    unit: str = "rad"

class Snapshot(msgspec.Struct, kw_only=True):
    pose: Pose
    at: datetime.datetime
    angles_rad: tuple[float, ...]
    mode: Mode = Mode.SLOW
    readings: list[Reading] = []
    error: str | None = None
    raw: bytes = b""
    flags: set[str] = set()

class Node(msgspec.Struct):
    name: str
    inner: "list[Node]" = []

class Moved(msgspec.Struct, tag=True):
    by_rad: float

class Stuck(msgspec.Struct, tag=True):
    why: str

class Odd(msgspec.Struct, rename={"class_": "class", "a_b": "a-b"}):
    class_: int
    a_b: int

class Compact(msgspec.Struct, array_like=True):
    a: int
    b: str

class Driver:
    @service(effect="read")
    def snapshot(self) -> Snapshot:
        utc = datetime.timezone.utc
        return Snapshot(pose=Pose(1.5), at=datetime.datetime(2025, 1, 2, tzinfo=utc), angles_rad=(0.5, 1.5),
                        readings=[Reading(2.5)], raw=b"\\x01", flags={"a"})
    @service(effect="read")
    def poses(self) -> dict[str, Pose]:
        return {"home": Pose(1.0, 2.0)}
    @service(effect="read")
    def maybe(self, there: bool) -> Pose | None:
        return Pose(1.0) if there else None
    @service(effect="read")
    def tree(self) -> Node:
        return Node("root", [Node("leaf")])
    @service(effect="read")
    def outcome(self) -> Moved | Stuck:
        return Stuck("sand")
    @service(effect="read")
    def odd(self) -> Odd:
        return Odd(1, 2)
    @service(effect="read")
    def compact(self) -> Compact:
        return Compact(1, "b")
    @service
    def go(self, pose: Pose) -> Pose:
        return Pose(pose.x_m + 1, pose.y_m)

trade.register(Driver(), "robot")
say("ready")
hear()
"""


@pytest.fixture
def ask(start_program: Any, here: Container) -> Callable[..., Any]:
    """Calls services of a process whose types this one has never seen."""
    program = start_program(PROGRAM)
    program.heard()
    return lambda name, *args: here.find(where(name=name, group="robot"), wait_s=20)(*args)


@pytest.mark.realtime
def test_results_of_unknown_types_are_records(ask: Callable[..., Any]) -> None:
    snapshot = ask("snapshot")
    assert (snapshot.pose.x_m, snapshot.pose.y_m) == (1.5, 0.25)
    assert snapshot.at == dt.datetime(2025, 1, 2, tzinfo=dt.timezone.utc)
    assert (snapshot.angles_rad, snapshot.flags) == ((0.5, 1.5), {"a"})
    assert (snapshot.mode, snapshot.error, snapshot.raw) == ("slow", None, b"\x01")
    assert (snapshot.readings[0].value, snapshot.readings[0].unit) == (2.5, "rad")
    assert ask("poses")["home"].y_m == 2.0
    assert (ask("maybe", True).x_m, ask("maybe", False)) == (1.0, None)
    assert ask("outcome") == {"type": "Stuck", "why": "sand"}  # which of two records it is, only their code can tell
    assert ask("compact") == (1, "b")
    assert ask("odd") == {"class": 1, "a-b": 2}
    tree = ask("tree")
    assert (tree.name, tree.inner) == ("root", [{"name": "leaf", "inner": []}])


@pytest.mark.realtime
def test_records_and_mappings_pass_as_arguments_of_unknown_types(ask: Callable[..., Any]) -> None:
    pose = ask("maybe", True)
    assert ask("go", pose).x_m == 2.0
    assert ask("go", {"x_m": 5.0}).x_m == 6.0


class Pose(msgspec.Struct):
    x_m: float


PATH = f"{Pose.__module__}:Pose"


def schema(properties: dict[str, Any]) -> dict[str, Any]:
    pose = {"title": "Pose", "type": "object", "properties": properties, "required": list(properties)}
    return {"$ref": "#/$defs/Pose", "$defs": {"Pose": pose}}


def test_a_type_the_caller_has_is_used() -> None:
    assert type_from_schema(schema({"x_m": {"type": "number"}}), {"Pose": PATH}) is Pose


def test_another_type_of_the_same_name_is_not_used() -> None:
    made = type_from_schema(schema({"angle_rad": {"type": "number"}}), {"Pose": PATH})
    assert made is not Pose
    assert msgspec.msgpack.decode(msgspec.msgpack.encode({"angle_rad": 0.5}), type=made).angle_rad == 0.5


def test_nothing_is_imported_because_a_description_says_so() -> None:
    type_from_schema(schema({}), {"Pose": "antigravity:Pose"})
    assert "antigravity" not in sys.modules


@pytest.mark.parametrize(
    "broken",
    [
        {"type": ["a"]},
        {"$ref": 5},
        {"anyOf": 5},
        {"anyOf": [{"type": "null"}, {"type": "null"}]},
        {"enum": [{}]},
        {"type": "object", "properties": {"a": 5}},
        {"type": "array", "items": {"$ref": "#/$defs/Missing"}},
    ],
    ids=str,
)
def test_a_result_with_a_description_that_makes_no_sense_stays_plain_data(
    here: Container, broken: dict[str, Any]
) -> None:
    info = ServiceInfo(name="go", signature="go()", result_schema=schema_message(broken, {}))
    assert result_decoder(here._parts.codec, info)(msgspec.msgpack.encode([1])) == [1]


DOOR = """
import enum, trade
from trade import service

class Lid(enum.Enum):
    OPEN, SHUT = "open", "shut"

class Jammed(Exception): pass

class Door:
    @service(effect="read")
    def lid(self) -> Lid:
        return Lid.SHUT

    @service
    def open(self) -> None:
        raise Jammed("it is nailed up")

if __name__ == "__main__":
    import sys
    trade.register(Door(), "door")
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.mark.realtime
def test_what_a_program_defines_is_known_by_the_name_it_is_imported_by(
    tmp_path: Path, system: str, here: Container, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It runs as ``__main__``, and each process has another one."""
    script = tmp_path / "hinged_door.py"
    script.write_text(DOOR)
    monkeypatch.syspath_prepend(tmp_path)
    hinged_door = importlib.import_module("hinged_door")
    command, environment = [sys.executable, str(script)], {**os.environ, "TRADE_SYSTEM": system}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"ready\n"
        assert here.find(where(name="lid", group="door"), wait_s=20)() is hinged_door.Lid.SHUT
        with pytest.raises(hinged_door.Jammed, match="it is nailed up"):
            here.find(where(name="open", group="door"), wait_s=20)()


def test_what_another_process_imports_may_be_defined_by_ones_own_program(monkeypatch: pytest.MonkeyPatch) -> None:
    program = types.ModuleType("__main__")
    program.__file__, program.__dict__["Pose"] = "/lab/sliding_door.py", Pose
    monkeypatch.setitem(sys.modules, "__main__", program)
    assert type_from_schema(schema({"x_m": {"type": "number"}}), {"Pose": "sliding_door:Pose"}) is Pose
    assert type_from_schema(schema({"x_m": {"type": "number"}}), {"Pose": "other_door:Pose"}) is not Pose


def test_an_enum_with_other_members_is_another_type() -> None:
    definition = {"title": "Lid", "enum": ["open", "ajar"]}
    made = type_from_schema({"$ref": "#/$defs/Lid", "$defs": {"Lid": definition}}, {"Lid": f"{__name__}:Lid"})
    assert made is not Lid
    assert get_args(made) == ("open", "ajar")


class Lid(enum.Enum):
    OPEN, SHUT = "open", "shut"
