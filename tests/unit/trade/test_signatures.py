"""What any client can read about a service before calling it."""

import datetime as dt
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest
from msgspec import Struct

from trade import Container, Handle, Meta, service, where

pytestmark = pytest.mark.virtual_time


class Pose(Struct):
    x_m: float
    y_m: float


@dataclass
class Goal:
    pose: Pose
    tolerance_m: float = 0.01


class Robot:
    @service
    def move(self, joint: str, angle_rad: Annotated[float, Meta(ge=-1, le=1)], *, speed: float = 0.5) -> bool:
        """Move a joint.

        Blocks until it arrives.
        """
        return True

    @service(effect="read")
    def poses(self, names: list[str] | None = None) -> dict[str, Pose]:
        return {}

    @service(effect="read")
    def plain(self, value: Any, other: Any = 1):  # type: ignore[no-untyped-def]
        return value

    @service(effect="read")
    def limited(
        self,
        share: Annotated[float, Meta(gt=0, lt=1)],
        name: Annotated[str, Meta(min_length=1, max_length=8)],
        steps: list[Annotated[int, Meta(ge=1, multiple_of=5)]],
        speed: Annotated[float, Meta(le=2.5)] | None = None,
    ) -> None: ...

    @service(effect="read")
    def times(self) -> tuple[dt.datetime, ...]:
        return ()

    @service
    def follow(self, leader: Handle, mode: Literal["near", "far"] = "near") -> None: ...

    @service
    def drive(self, goal: Goal) -> None: ...

    @service(effect="read")
    def exact(self, value: int, /, anything: Any) -> set[int]:
        return {value}


@pytest.fixture
def robot(here: Container) -> dict[str, Handle]:
    return {handle.name: handle for handle in here.register(Robot(), "rosie")}


TEXTS = {
    "move": "move(joint: str, angle_rad: float (-1 to 1), *, speed: float = 0.5) -> bool",
    "poses": "poses(names: list[str] | None = None) -> dict[str, Pose]",
    "plain": "plain(value, other=1)",
    "limited": "limited(share: float (> 0, < 1), name: str (at least 1 long, at most 8 long), "
    "steps: list[int (>= 1, a multiple of 5)], speed: float (<= 2.5) | None = None) -> None",
    "times": "times() -> tuple[datetime, ...]",
    "follow": "follow(leader: Handle, mode: Literal['near', 'far'] = 'near') -> None",
    "drive": "drive(goal: Goal) -> None",
    "exact": "exact(value: int, /, anything) -> set[int]",
}


@pytest.mark.parametrize("name", TEXTS)
def test_the_signature_reads_like_python(robot: dict[str, Handle], name: str) -> None:
    assert robot[name].signature == TEXTS[name]


def test_the_docstring_is_shown(robot: dict[str, Handle]) -> None:
    assert robot["move"].doc == "Move a joint.\n\nBlocks until it arrives."


def test_arguments_and_result_are_described_as_json_schema(robot: dict[str, Handle]) -> None:
    schema = robot["move"].schema
    assert schema["arguments"]["properties"]["angle_rad"] == {"type": "number", "minimum": -1, "maximum": 1}
    assert schema["arguments"]["required"] == ["joint", "angle_rad"]
    assert schema["result"] == {"type": "boolean"}


def test_structs_and_dataclasses_are_described_in_full(robot: dict[str, Handle]) -> None:
    definitions = robot["drive"].schema["arguments"]["$defs"]
    assert set(definitions) == {"Goal", "Pose"}
    assert set(definitions["Pose"]["properties"]) == {"x_m", "y_m"}
    assert definitions["Goal"]["required"] == ["pose"]


def test_a_handle_is_described_as_a_handle(robot: dict[str, Handle]) -> None:
    assert robot["follow"].schema["arguments"]["properties"]["leader"]["title"] == "Handle"


def test_another_container_reads_the_same_description(here: Container, there: Container) -> None:
    (described,) = there.register(type("One", (), {"move": Robot.move})(), "rosie")
    seen = here.find(where(name="move"), wait_s=20)
    assert (seen.signature, seen.schema, seen.doc) == (described.signature, described.schema, described.doc)
