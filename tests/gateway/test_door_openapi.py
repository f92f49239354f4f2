"""The document of the door says what there is, and the door keeps to it."""

import enum
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from msgspec import Meta, Struct

from doors import Opened, opened
from jointed import Robot
from trade import service
from trade.testing import memory_system


class Shade(enum.Enum):
    WARM = "warm"
    COLD = "cold"


class Colour(Struct):
    red: Annotated[int, Meta(ge=0, le=255)]
    green: Annotated[int, Meta(ge=0, le=255)] = 0
    shade: Shade = Shade.WARM


class Lamp:
    """Of every kind of argument a little."""

    def __init__(self) -> None:
        self.colours: list[Colour] = []

    @service
    def set(self, level: Annotated[float, Meta(ge=0, le=1)], colour: Colour | None = None) -> float:
        """How bright, and in which colour."""
        self.colours += [] if colour is None else [colour]
        return level

    @service
    def show(self, *, colours: Annotated[list[Colour], Meta(max_length=3)], label: str = "") -> dict[str, Colour]:
        return {f"{label}{number}": colour for number, colour in enumerate(colours)}

    @service(effect="read")
    def state(self) -> list[Colour]:
        return self.colours[-3:]

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def door(tmp_path: Path) -> Iterator[Opened]:
    with memory_system() as system:
        robot = Robot(system, "")
        system.container("lamps").register(Lamp(), "lamp")
        system.settle()
        with opened(robot.me, tmp_path) as (made, tokens):
            yield Opened(robot, made, tokens)


def test_each_service_is_described_with_its_arguments(door: Opened) -> None:
    told = door.client().ask("GET", "/openapi.json").body
    assert told["openapi"].startswith("3.1")
    operation = told["paths"]["/call/lamp/set"]["post"]
    assert operation["summary"].startswith("set(level: float (0 to 1)")
    assert operation["description"] == "How bright, and in which colour."
    body = operation["requestBody"]["content"]["application/json"]["schema"]
    named, by_place = body["properties"]["args"]["anyOf"]
    assert named["properties"]["level"] == {"type": "number", "minimum": 0, "maximum": 1}
    assert named["required"] == ["level"]
    assert by_place["minItems"] == 1
    assert "lamp.set.Colour" in told["components"]["schemas"]
    only_named = told["paths"]["/call/lamp/show"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert [kind["type"] for kind in only_named["properties"]["args"]["anyOf"]] == ["object"]


def test_what_comes_and_goes_is_in_the_document_as_it_does(door: Opened) -> None:
    anna, lamp = door.client(), Lamp()
    home = door.robot.system.container("lamps")
    home.register(lamp, "hall")
    door.robot.system.settle()
    assert "/call/hall/set" in anna.ask("GET", "/openapi.json").body["paths"]
    home.deregister(lamp)
    door.robot.system.settle()
    assert "/call/hall/set" not in anna.ask("GET", "/openapi.json").body["paths"]


@pytest.mark.skipif(sys.version_info < (3, 11), reason="schemathesis needs Python 3.11")
@pytest.mark.parametrize("mode", ["positive", "negative"])
def test_the_door_keeps_to_its_document(door: Opened, mode: str) -> None:
    """Whatever schemathesis thinks of is answered as the document says; what it forbids is refused."""
    import schemathesis
    from schemathesis.checks import not_a_server_error

    anna = door.client()
    schema = schemathesis.openapi.from_dict(anna.ask("GET", "/openapi.json").body)
    answered: set[tuple[str, int]] = set()
    for found in schema.get_all_operations():
        operation = found.ok()

        @given(case=operation.as_strategy(generation_mode=schemathesis.GenerationMode(mode)))
        @settings(
            max_examples=15, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
        )
        def keeps_to_it(case: schemathesis.Case) -> None:
            case.headers["Authorization"] = f"Bearer {anna.token}"  # who shows none is another test's
            answer = case.call(base_url=anna.url, timeout=60)
            late = answer.status_code == 504 and answer.json()["data"]["deadline_s"] < 1.0  # it may ask for as little
            case.validate_response(answer, excluded_checks=[not_a_server_error] if late else None)
            answered.add((case.operation.path, answer.status_code))

        try:
            keeps_to_it()
        except Unsatisfiable:  # it takes nothing that could be wrong
            assert mode == "negative"
    done = 200 if mode == "positive" else 400
    assert {("/call/lamp/set", done), ("/call/lamp/show", done), ("/estop", done)} <= answered
