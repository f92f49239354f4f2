"""Commands of other packages, found by their entry points: they are added, cannot break others, and replace none."""

from collections.abc import Callable
from importlib import invalidate_caches
from pathlib import Path

import pytest
from typer.testing import CliRunner

from trade.errors import ConfigurationError
from trade_gateway.cli import build
from trade_gateway.terminal.sections import HARDWARE

pytestmark = pytest.mark.virtual_time

Install = Callable[..., None]
GREETS = f'''
import typer
from trade_gateway.terminal import Json, Output

SECTION = {HARDWARE!r}
PLACE = 1


def greet(context: typer.Context, name: str, as_json: Json = False) -> None:
    """Greet a robot."""
    Output(as_json=as_json).data({{"greeted": name, "system": context.obj.system}})
'''


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Installs a package as pip does: a module and an entry point of that name."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(package: str, command: str, source: str, attribute: str) -> None:
        (tmp_path / f"{package}.py").write_text(source)
        about = tmp_path / f"{package}-1.2.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
        (about / "entry_points.txt").write_text(f"[trade.commands]\n{command} = {package}:{attribute}\n")
        invalidate_caches()

    return install


def _help() -> str:
    shown = CliRunner().invoke(build(), ["--help"])
    assert shown.exit_code == 0
    return shown.output


def test_an_installed_package_adds_a_command_in_its_section(install: Install) -> None:
    install("greeting_of_acme", "greet", GREETS, "greet")
    ran = CliRunner().invoke(build("greet"), ["--system", "lab", "greet", "rosie", "--json"])
    assert ran.output == '{"greeted":"rosie","system":"lab"}\n'
    lines = _help().splitlines()
    [own] = [number for number, line in enumerate(lines) if "Greet a robot." in line]
    assert "scan" in next(line for line in reversed(lines[:own]) if line[2:3] != " ")
    assert "set-id" in lines[own + 1]


@pytest.mark.parametrize(
    ("source", "attribute", "reason"),
    [
        ("import no_such_library", "run", "No module named 'no_such_library'"),
        ("", "run", "has no attribute 'run'"),
        ("run = 3", "run", "is not a callable object"),
        ("def run(what: lambda: 0) -> None: ...", "run", "Type not yet supported"),
    ],
)
def test_a_broken_command_is_named_and_the_others_run(
    install: Install, source: str, attribute: str, reason: str
) -> None:
    package = f"broken_{abs(hash(source))}"
    install(package, "broken", source, attribute)
    assert "Other packages" in _help()
    assert CliRunner().invoke(build("doctor"), ["doctor", "--help"]).exit_code == 0
    error = CliRunner().invoke(build("broken"), ["broken", "--what", "7", "words"]).exception
    assert isinstance(error, ConfigurationError)
    assert error.where == "trade broken"
    assert error.problem.startswith(f"{package}:{attribute} of {package} 1.2 cannot be loaded: ")
    assert reason in error.problem


def test_two_packages_with_one_command_are_both_named(install: Install) -> None:
    install("first_of_two", "greet", GREETS, "greet")
    install("second_of_two", "greet", GREETS, "greet")
    error = CliRunner().invoke(build("greet"), ["greet"]).exception
    assert isinstance(error, ConfigurationError)
    both = "first_of_two:greet of first_of_two 1.2 and second_of_two:greet of second_of_two 1.2"
    assert error.problem == f"two packages have a command of this name: {both}. Uninstall one"


@pytest.mark.parametrize("name", ["stop", "ros"])
def test_no_package_replaces_a_command_of_trade(install: Install, name: str) -> None:
    install(f"in_place_of_{name}", name, GREETS, "greet")
    assert "Greet a robot." not in _help()
    assert "Greet a robot." not in CliRunner().invoke(build(name), [name, "--help"]).output


def test_a_command_of_a_package_of_this_project_names_it_where_it_is_not_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    error = CliRunner().invoke(build("drill"), ["drill", "head.toml"]).exception
    assert isinstance(error, ConfigurationError)
    assert str(error) == "trade drill: needs trade-checks; pip install trade-checks"
    assert "drill" not in _help()
