"""The document of the HTTP gateway says what there is, and the HTTP gateway keeps to it."""

import datetime as dt
import enum
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from msgspec import Meta, Struct

from tests.support.http_clients import Opened, opened
from tests.support.two_joint_robot import Robot
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

    @service
    def blend(self, ends: tuple[Colour, float], steps: int = 2, *, only: Literal["warm", "cold"] | None = None) -> None:
        """A tuple has an end."""

    @service
    def dim(self, level: float, /) -> None:
        """What is given by place only."""

    @service(effect="read")
    def when(self) -> dt.datetime:
        return dt.datetime(2026, 11, 24, tzinfo=dt.timezone.utc)

    @service(effect="read")
    def state(self) -> list[Colour]:
        return self.colours[-3:]

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Opened]:
    with memory_system() as system:
        robot = Robot(system, "")
        system.container("lamps").register(Lamp(), "lamp")
        system.settle()
        with opened(robot.me, tmp_path) as (made, tokens):
            yield Opened(robot, made, tokens)


def test_each_service_is_described_with_its_arguments(served: Opened) -> None:
    reported = served.client().ask("GET", "/openapi.json").body
    assert reported["openapi"].startswith("3.1")
    operation = reported["paths"]["/call/lamp/set"]["post"]
    assert operation["summary"].startswith("set(level: float (0 to 1)")
    assert operation["description"] == "How bright, and in which colour."
    body = operation["requestBody"]["content"]["application/json"]["schema"]
    named = body["properties"]["args"]
    assert named["properties"]["level"] == {"type": "number", "minimum": 0, "maximum": 1}
    assert named["required"] == ["level"]
    assert "lamp.set.Colour" in reported["components"]["schemas"]


def test_what_comes_and_goes_is_in_the_document_as_it_does(served: Opened) -> None:
    anna, lamp = served.client(), Lamp()
    home = served.robot.system.container("lamps")
    home.register(lamp, "hall")
    served.robot.system.settle()
    assert "/call/hall/set" in anna.ask("GET", "/openapi.json").body["paths"]
    home.deregister(lamp)
    served.robot.system.settle()
    assert "/call/hall/set" not in anna.ask("GET", "/openapi.json").body["paths"]


def test_each_operation_has_a_unique_name_and_generators_read_all_of_the_document(served: Opened) -> None:
    reported = served.client().ask("GET", "/openapi.json").body
    names = [operation["operationId"] for path in reported["paths"].values() for operation in path.values()]
    assert len(names) == len(set(names))
    text = json.dumps(reported)
    assert '"items": false' not in text
    assert '"title": "' not in text.replace('"title": "TRADE"', "")
    ends = reported["paths"]["/call/lamp/blend"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert ends["properties"]["args"]["properties"]["ends"]["maxItems"] == 2


def test_what_is_given_by_place_only_is_called_as_the_document_says(served: Opened) -> None:
    anna = served.client()
    assert anna.ask("POST", "/call/lamp/dim", {"args": {"level": 0.5}}).status == 200
    assert anna.ask("POST", "/call/lamp/dim", {"args": [0.5]}).status == 200


UV = os.environ.get("UV") or shutil.which("uv") or str(Path(__file__).parents[3] / ".uv" / "bin" / "uv")
PYTHON_CLIENT = (UV, "tool", "run", "--from", "openapi-python-client==0.28.4")
JAVA_CLIENT = (UV, "tool", "run", "openapi-generator-cli==7.26.0")
TYPESCRIPT = ("npx", "--yes", "--package", "openapi-typescript@7.13.0", "--package", "typescript@5.9.3")
CALLS = """
import sys
from trade_client import AuthenticatedClient
from trade_client.api.gateway import services
from trade_client.api.lamp import lamp_set
from trade_client.models import LampSetBody, LampSetBodyArgs, LampSetColour
with AuthenticatedClient(sys.argv[1], sys.argv[2]) as client:
    assert "lamp.set" in {f"{one.group}.{one.name}" for one in services.sync(client=client)}
    args = LampSetBodyArgs(level=0.5, colour=LampSetColour(red=7))
    print(lamp_set.sync(client=client, body=LampSetBody(args=args)).result)
    print(lamp_set.sync(client=client, body=LampSetBody(args=LampSetBodyArgs(level=2.0))).title)
"""


def _run(folder: Path, *command: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=500, check=False)


def _needs(folder: Path, *command: str) -> None:
    """Skip where a tool is not on this machine and cannot be fetched."""
    if shutil.which(command[0]) is None or _run(folder, *command).returncode != 0:
        pytest.skip(f"{' '.join(command[:-1])} is not on this machine and cannot be fetched")


@pytest.fixture
def described(served: Opened, tmp_path: Path) -> Path:
    path = tmp_path / "served.json"
    path.write_text(json.dumps(served.client().ask("GET", "/openapi.json").body), encoding="utf-8")
    return path


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_generated_client_in_python_calls_services(served: Opened, described: Path) -> None:
    folder = described.parent
    _needs(folder, *PYTHON_CLIENT, "openapi-python-client", "--version")
    words = ("generate", "--path", described.name, "--meta", "none", "--output-path", "trade_client")
    made = _run(folder, *PYTHON_CLIENT, "openapi-python-client", *words, "--fail-on-warning")
    assert made.returncode == 0, made.stdout + made.stderr
    (folder / "calls.py").write_text(CALLS, encoding="utf-8")
    anna = served.client()
    called = _run(folder, *PYTHON_CLIENT, "python", "calls.py", anna.url, anna.token)
    assert called.stdout.split() == ["0.5", "InvalidArgument"], called.stderr


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("library", ["okhttp-gson", "native"])
def test_a_generated_client_in_java_compiles(described: Path, library: str) -> None:
    folder = described.parent
    _needs(folder, "java", "-version")
    _needs(folder, *JAVA_CLIENT, "version")
    words = ("generate", "-i", described.name, "-g", "java", "--library", library, "-o", "java")
    made = _run(folder, *JAVA_CLIENT, *words)
    assert made.returncode == 0, made.stdout[-4000:] + made.stderr[-4000:]
    assert "Empty operationId" not in made.stdout + made.stderr
    _needs(folder / "java", "mvn", "-q", "-B", "dependency:resolve")
    compiled = _run(folder / "java", "mvn", "-q", "-B", "compile")
    assert compiled.returncode == 0, compiled.stdout[-4000:]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_generated_types_in_typescript_compile(described: Path) -> None:
    folder = described.parent
    _needs(folder, *TYPESCRIPT, "tsc", "--version")
    made = _run(folder, *TYPESCRIPT, "openapi-typescript", described.name, "--output", "served.ts")
    assert made.returncode == 0, made.stderr
    checked = _run(folder, *TYPESCRIPT, "tsc", "--noEmit", "--strict", "served.ts")
    assert checked.returncode == 0, checked.stdout


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info < (3, 11), reason="schemathesis needs Python 3.11")
@pytest.mark.parametrize("mode", ["positive", "negative"])
def test_answers_match_the_openapi_document(served: Opened, mode: str) -> None:
    """Whatever schemathesis thinks of is answered as the document says; what it forbids is refused."""
    import schemathesis
    from schemathesis.checks import not_a_server_error

    anna = served.client()
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
