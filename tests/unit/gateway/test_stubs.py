"""`trade stubs` writes classes that mypy and pyright understand, and that `trade.robot` takes."""

import ast
import runpy
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec import Raw, Struct
from typer.testing import CliRunner

from tests.conftest import StartContainer
from tests.support.type_checkers import CHECKERS, checked, seeded
from trade import Container, GroupView, Handle, Meta, service
from trade._registry.registry import Record
from trade.protocol.keys import Address, ServiceKey
from trade.protocol.messages import Parameter, ServiceInfo, encode_message
from trade.testing import memory_system
from trade_drivers.testing import FakeJointGroup
from trade_gateway.cli import build
from trade_gateway.stubs import write_stubs

pytestmark = pytest.mark.virtual_time

BEHAVIOUR = Path(__file__).with_name("stubbed_behaviour.py")
NUMBER = {"type": "number"}


class Reading(Struct, frozen=True):
    celsius: float
    at_s: float
    label: str | None = None


class Oven:
    @service(effect="read")
    def temperature(self) -> Reading:
        """The temperature inside."""
        return Reading(20.0, 0.0)

    @service
    def heat(
        self,
        celsius: Annotated[float, Meta(ge=0)],
        mode: Literal["bake", "toast"] = "bake",
        *,
        at: Reading | None = None,
    ) -> float:
        r"""Heats, with a \ in its text; the temperature before."""
        return at.celsius if at is not None else celsius


@pytest.fixture
def robot() -> Iterator[Container]:
    """A robot with a head, and with ovens in groups of ordinary and of other names."""
    with memory_system() as system:
        container = system.container("rosie")
        container.register(FakeJointGroup(["rosie.neck.pan", "rosie.neck.tilt"]), "rosie.head")
        for group in ("rosie.oven", "rosie.left-arm", "rosie.class"):
            container.register(Oven(), group)
        yield container


class Anywhere:
    """A container of a registry that holds anything; see `handle`."""

    closed = False

    def record(self, handle: Handle) -> Record | None:
        return handle.last_record


def handle(
    label: str, *parameters: Parameter, container: str = "odd", schema: Any = None, result: Any = None, doc: str = ""
) -> Handle:
    """A service as a peer in any language may describe it."""
    group, _, name = label.rpartition(".")
    key = ServiceKey(Address("peer", container, "e1"), "rosie", "p", name)
    info = ServiceInfo(
        name=name,
        signature=f"{name}()",
        doc=doc,
        parameters=parameters,
        arguments_schema=Raw(encode_message(schema or {})),
        result_schema=Raw(encode_message(result or {})),
    )
    record = Record(key, info, (group,), "Odd", "host", 1, False, (), {}, "healthy", {})
    return Handle(Anywhere(), key, record)  # type: ignore[arg-type]


def odd_services() -> list[Handle]:
    """Names, parameters, schemas and docs that Python has no words for, or that are attacks on the reader."""
    code = '"""\nimport os  # not in a string any more\n"""\\'
    record = {"type": "object", "title": "float; import os", "properties": {"list": NUMBER, "class": NUMBER}}
    return [
        handle("rosie.list", result={"type": "array", "items": {"type": "integer"}}),
        handle("rosie.set", Parameter("list"), schema={"properties": {"list": {"type": "array", "items": NUMBER}}}),
        handle("rosie.Any"),
        handle("rosie.property", result={"$ref": "#/$defs/float", "$defs": {"float": record}}),
        handle("rosie.Handle", result={**record, "title": "Handle"}),
        handle("rosie.Cup", result={**record, "title": "Cup"}),
        handle("rosie.import", doc=code),
        handle("rosie.lambda"),
        handle("rosie.lambda_"),
        handle("rosie._hidden"),
        handle("rosie.käse"),
        handle("rosie.keywords", Parameter("lambda"), Parameter("x")),
        handle("rosie.itself", Parameter("self")),
        handle("rosie.order", Parameter("a", required=False), Parameter("b")),
        handle("rosie.twice", Parameter("a"), Parameter("a")),
        handle("rosie.places", Parameter("a", positional_only=True), Parameter("b", required=False, keyword_only=True)),
        handle("rosie.broken", Parameter("a"), schema={"properties": 7}, result={"$ref": 7}),
        handle("rosie.mixed", result={"enum": [1.5, "a"]}),
        handle("rosie.both"),
        handle("rosie.both.inner"),
        handle("rosie.double", container="one"),
        handle("rosie.double", container="two"),
    ]


def members(text: str, name: str) -> set[str]:
    """The names of the methods of a class."""
    [found] = [node for node in ast.parse(text).body if isinstance(node, ast.ClassDef) and node.name == name]
    return {node.name for node in found.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.realtime
@pytest.mark.parametrize("checker", CHECKERS)
def test_both_checkers_find_each_wrong_line_over_a_module_and_over_a_stub(
    checker: str, robot: Container, tmp_path: Path
) -> None:
    cache = tmp_path / "checker"
    cache.mkdir()
    text = write_stubs(robot.services("rosie"), "rosie", "memory")
    files = [
        tmp_path / name for name in ("rosie_types.py", "rosie_stub.pyi", "odd_types.py", BEHAVIOUR.name, "over.py")
    ]
    module, stub, odd, behaviour, over = files
    module.write_text(text)
    stub.write_text(text)
    odd.write_text(write_stubs(odd_services(), "rosie", "memory"))
    shutil.copy(BEHAVIOUR, behaviour)
    over.write_text(BEHAVIOUR.read_text().replace("rosie_types", "rosie_stub"))
    wrong = seeded(behaviour)
    assert len(wrong) == 12
    found, said = checked(checker, files, cache)
    assert found == sorted([*wrong, *seeded(over)]), said


def test_the_module_runs_and_its_class_is_taken(robot: Container, tmp_path: Path) -> None:
    module = tmp_path / "rosie_types.py"
    module.write_text(write_stubs(robot.services("rosie"), "rosie", "memory"))
    kind = runpy.run_path(str(module))["Rosie"]
    rosie = robot.robot("rosie", kind)
    assert isinstance(rosie, GroupView)
    assert rosie.head.move_to([0.3, -0.2]) == [0.3, -0.2]
    assert rosie["left-arm"].temperature().celsius == 20.0


def test_a_kind_that_is_no_class_is_refused(robot: Container) -> None:
    with pytest.raises(ValueError, match="kind must be a class, not 'Rosie'"):
        robot.robot("rosie", "Rosie")  # type: ignore[call-overload]


def test_a_record_can_be_given_as_an_object_or_as_a_mapping(robot: Container) -> None:
    oven = robot.robot("rosie").oven
    for reading in (oven.temperature(), {"celsius": 20.0, "at_s": 0.0}):
        assert oven.heat(180.0, at=reading) == 20.0


def test_the_head_names_system_group_and_command_and_no_time(robot: Container) -> None:
    first, second, third, *_ = write_stubs(robot.services("rosie"), "rosie", "memory").splitlines()
    assert first == "# Types of the group rosie in the system memory, as its services described themselves."
    assert second == "# Written by: trade --system memory stubs rosie"
    assert third == "# Use: robot = trade.robot('rosie', Rosie)"


@settings(deadline=None, derandomize=True, database=None)
@given(st.text(), st.text(), st.text(), st.text(), st.text())
@example("move", "\0", "angle", "Reading", "celsius")
@example("move", '"""\nimport os', "angle", "Reading", "celsius")
@example("move", "a\\", "angle", "Reading", 'a"')
@example("move", "a\r\n", "self", "class", "class")
def test_any_texts_of_a_peer_give_a_module(name: str, doc: str, parameter: str, title: str, field: str) -> None:
    record = {"type": "object", "title": title, "properties": {field: {"enum": [doc]}}, "required": [field]}
    odd = handle(
        f"rosie.{name}", Parameter(parameter), schema={"properties": {parameter: record}}, result=record, doc=doc
    )
    tree = ast.parse(write_stubs([odd], "rosie", "memory"))
    allowed = (ast.Import, ast.ImportFrom, ast.Assign, ast.FunctionDef, ast.ClassDef)
    assert all(isinstance(node, allowed) for node in tree.body)
    inside = [node for kind in tree.body if isinstance(kind, ast.ClassDef) for node in kind.body]
    assert all(isinstance(node, ast.Expr | ast.FunctionDef) for node in inside)


@pytest.mark.parametrize("order", [1, -1])
def test_the_same_services_give_the_same_text(order: int, robot: Container) -> None:
    handles: Sequence[Handle] = robot.services("rosie")
    assert write_stubs(handles[::order], "rosie", "memory") == write_stubs(handles, "rosie", "memory")
    assert write_stubs(odd_services()[::order], "rosie", "memory") == write_stubs(odd_services(), "rosie", "memory")


def test_names_that_are_no_attributes_are_left_out_or_are_indexes() -> None:
    text = write_stubs(odd_services(), "rosie", "memory")
    rosie = members(text, "Rosie")
    assert {"list", "set", "Any", "import_", "lambda_", "keywords", "__getitem__"} <= rosie
    assert "def Cup(self) -> Cup2:" in text
    assert rosie.isdisjoint({"import", "lambda", "_hidden", "käse", "both", "double"})
    assert "Literal['lambda']" in text
    assert "# 'both' is no attribute: it is a service and a group; use trade.find or trade.robot" in text
    assert "# 'double' is no attribute: 2 services have this name; select one with trade.find and its container" in text


def test_parameters_that_python_cannot_express_are_of_any_kind() -> None:
    text = write_stubs(odd_services(), "rosie", "memory")
    for name in ("keywords", "itself", "order", "twice", "broken"):
        assert f"def {name}(self, *args: _typing.Any, **kwargs: _typing.Any)" in text
    assert "def places(self, a: _typing.Any, /, *, b: _typing.Any = ...)" in text


def test_texts_of_peers_stay_texts(tmp_path: Path) -> None:
    """A module that a hostile peer has described imports nothing of that peer's choice."""
    text = write_stubs(odd_services(), "rosie", "memory")
    imported = {
        name
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [one.name for one in node.names])
    }
    assert imported == {"__future__", "builtins", "collections.abc", "trade", "typing"}
    module = tmp_path / "odd.py"
    module.write_text(text)
    assert "Rosie" in runpy.run_path(str(module))


def test_the_command_prints_or_writes_the_module(start_container: StartContainer, system: str, tmp_path: Path) -> None:
    start_container("rosie").register(Oven(), "rosie.oven")
    printed = CliRunner().invoke(build(), ["stubs", "rosie"], catch_exceptions=False)
    assert printed.exit_code == 0
    assert f"# Written by: trade --system {system} stubs rosie" in printed.output
    assert members(printed.output, "RosieOven") == {"heat", "temperature", "__getitem__"}
    file = tmp_path / "rosie_types.py"
    written = CliRunner().invoke(build(), ["stubs", "rosie", "--output", str(file)], catch_exceptions=False)
    assert written.exit_code == 0
    assert written.output == ""
    assert file.read_text() == printed.output


def test_the_command_refuses_a_group_that_is_none_and_writes_nothing(system: str, tmp_path: Path) -> None:
    file = tmp_path / "rosie_types.py"
    for group in ("rosie", "rosie..head"):
        done = CliRunner().invoke(build(), ["stubs", group, "--output", str(file), "--wait", "0"])
        assert done.exit_code != 0
        assert not file.exists()
