"""``where(args=..., returns=...)``: types compared as JSON Schema, so that no foreign code is needed."""

import datetime as dt
import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta, Struct

from trade import Container, Handle, service, where
from trade.protocol.messages import NO_SCHEMA, Parameter, ServiceInfo
from trade.protocol.schema import fits, schema_message

pytestmark = pytest.mark.virtual_time


class Point(Struct):
    x_m: float
    y_m: float


class Pose(Struct):
    x_m: float
    y_m: float
    angle_rad: float = 0.0


@dataclass
class Spot:
    x_m: int
    y_m: int


class Tree(Struct):
    leaves: list["Tree"] = []


class Side(enum.Enum):
    LEFT = "left"
    RIGHT = "right"


class Robot:
    @service
    def nothing(self) -> None: ...
    @service
    def speed(self, fraction: Annotated[float, Meta(ge=0, le=1)]) -> bool: ...
    @service
    def count(self, number: int, name: str = "") -> int: ...
    @service
    def go(self, target: Point, *, fast: bool = False) -> Pose: ...
    @service
    def keyword(self, *, fast: bool) -> Point: ...
    @service
    def anything(self, value: Any): ...  # type: ignore[no-untyped-def]
    @service
    def tell(self, who: Handle) -> Handle: ...
    @service
    def points(self, points: list[Point]) -> list[Pose]: ...
    @service
    def pair(self, pair: tuple[int, str]) -> tuple[int, str]: ...
    @service
    def at(self, when: dt.datetime) -> dt.datetime: ...
    @service
    def raw(self, data: bytes) -> bytes: ...
    @service
    def choose(self, side: Literal["left", "right"]) -> Side: ...
    @service
    def plant(self, tree: Tree) -> Tree: ...
    @service
    def maybe(self, number: int | None) -> int | None: ...
    @service
    def table(self, table: dict[str, float]) -> dict[str, int]: ...


ARGS: list[tuple[list[Any], str]] = [
    ([], "nothing"),
    ([float], "anything speed"),
    ([int], "anything count maybe speed"),
    ([int, str], "count"),
    ([int, int], ""),
    ([str], "anything"),
    ([bool], "anything"),
    ([None], "anything maybe"),
    ([int | None], "anything maybe"),
    ([Point], "anything go table"),
    ([Pose], "anything go table"),
    ([Spot], "anything go table"),
    ([Handle], "anything tell"),
    ([list[Point]], "anything points"),
    ([list[Spot]], "anything points"),
    ([list[int]], "anything"),
    ([set[Point]], "anything points"),
    ([tuple[int, str]], "anything pair"),
    ([tuple[str, int]], "anything"),
    ([dt.datetime], "anything at"),
    ([bytes], "anything raw"),
    ([Literal["left"]], "anything choose"),
    ([Side], "anything choose"),
    ([Literal["up"]], "anything"),
    ([Tree], "anything plant"),
    ([dict[str, int]], "anything table"),
    ([dict[str, str]], "anything"),
    ([Any, Any], "count"),
    ([float, float, float], ""),
]

RETURNS: list[tuple[Any, str]] = [
    (None, "nothing"),
    (bool, "speed"),
    (int, "count"),
    (float, "count"),
    (int | None, "count maybe nothing"),
    (Point, "go keyword"),
    (Pose, "go keyword"),
    (Handle, "tell"),
    (list[Point], "points"),
    (list[int], ""),
    (tuple[int, str], "pair"),
    (dt.datetime, "at"),
    (str, "choose"),
    (dt.timedelta, ""),
    (Side, "choose"),
    (bytes, "raw"),
    (Tree, "plant"),
    (dict[str, float], "go keyword table"),
]


def _names(container: Container, **asked: Any) -> str:
    handles = container.services(where(group="robot", **asked))
    return " ".join(sorted(handle.name for handle in handles))


@pytest.fixture
def robot(offer: Callable[..., Any]) -> None:
    offer(Robot())("nothing")


@pytest.mark.usefixtures("robot")
def test_args_finds_what_can_be_called_with_them(here: Container) -> None:
    for types, names in ARGS:
        assert (types, _names(here, args=types)) == (types, names)


@pytest.mark.usefixtures("robot")
def test_returns_finds_what_yields_such_a_value(here: Container) -> None:
    for kind, names in RETURNS:
        assert (kind, _names(here, returns=kind)) == (kind, names)
    assert len(here.services(where(group="robot", returns=Any))) == 15


_foreign = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 3) | st.sampled_from(["array", "object", "#/$defs/A", "string"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(
                [
                    "type",
                    "items",
                    "prefixItems",
                    "properties",
                    "required",
                    "anyOf",
                    "allOf",
                    "enum",
                    "$ref",
                    "$defs",
                    "A",
                ]
            ),
            inner,
            max_size=4,
        )
    ),
    max_leaves=12,
)


@given(st.dictionaries(st.sampled_from(["type", "$ref", "anyOf", "$defs", "properties", "enum"]), _foreign), _foreign)
def test_foreign_schemas_break_nothing(schema: dict[str, Any], more: Any) -> None:
    info = ServiceInfo(
        name="go",
        signature="go(a)",
        arguments_schema=schema_message({"properties": {"a": schema}}, more) if isinstance(more, dict) else NO_SCHEMA,
        result_schema=schema_message(schema, {}),
        parameters=(Parameter("a"),),
    )
    decoded = msgspec.msgpack.decode(msgspec.msgpack.encode(info), type=ServiceInfo)
    from trade._registry.constraints import _returns, _takes, types_text

    for kind in (int, Point, list[Tree], Tree, Any):
        assert _returns(decoded, types_text([kind])) in (True, False)
        assert _takes(decoded, types_text([kind])) in (True, False)


def test_references_in_a_circle_fit_nothing() -> None:
    circle = {"A": {"$ref": "#/$defs/B"}, "B": {"$ref": "#/$defs/A"}}
    assert not fits({"$ref": "#/$defs/A"}, circle, {"type": "integer"}, {})
