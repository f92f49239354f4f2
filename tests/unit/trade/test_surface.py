"""The public surface: what ``trade`` exports exists, is documented, and asks nothing special of the system."""

import inspect
import pydoc
import re
from typing import Any

import pytest

import trade
from tests.docs.blocks import DOCS

pytestmark = pytest.mark.virtual_time


@pytest.mark.parametrize("name", trade.__all__)
def test_every_public_name_exists_and_is_documented(name: str) -> None:
    assert inspect.getdoc(getattr(trade, name))


@pytest.mark.parametrize("name", trade.__all__)
def test_help_can_be_asked_for_and_shows_nothing_of_the_environment(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    secret = "sesame-of-the-environment"
    monkeypatch.setenv("TRADE_CREDENTIALS", f"me:{secret}")
    assert secret not in pydoc.render_doc(getattr(trade, name))


def _public_methods() -> list[Any]:
    kinds = [getattr(trade, name) for name in trade.__all__ if inspect.isclass(getattr(trade, name))]
    return [
        pytest.param(member, id=f"{kind.__name__}.{name}")
        for kind in kinds
        if kind.__module__.startswith("trade")
        for name, member in vars(kind).items()
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property))
    ]


@pytest.mark.parametrize("member", _public_methods())
def test_every_public_method_is_documented(member: Any) -> None:
    assert inspect.getdoc(member)


@pytest.mark.parametrize("name", ["lock", "find", "stream", "every", "estop_clear", "set_tracing"])
def test_help_of_a_function_says_what_its_method_says(name: str) -> None:
    assert inspect.getdoc(getattr(trade, name)) == inspect.getdoc(getattr(trade.Container, name))


def test_no_function_sends_its_reader_to_another_page() -> None:
    functions = [getattr(trade, name) for name in trade.__all__ if inspect.isfunction(getattr(trade, name))]
    assert [one.__name__ for one in functions if "see `Container." in (inspect.getdoc(one) or "").lower()] == []


def _left_out() -> list[Any]:
    text = (DOCS / "reference" / "trade.md").read_text(encoding="utf-8")
    found = re.findall(
        r"^::: trade\.(\w+)\n    options:\n(?:      merge.*\n)?      filters: .*\^\((.*)\)\$", text, re.MULTILINE
    )
    return [pytest.param(kind, name, id=f"{kind}.{name}") for kind, names in found for name in names.split("|")]


@pytest.mark.parametrize(("kind", "name"), _left_out())
def test_names_that_the_reference_omits_exist(kind: str, name: str) -> None:
    """A name that was changed would be on the page again."""
    made = getattr(trade, kind)
    assert hasattr(made, name) or f"self.{name}" in inspect.getsource(made)


def test_the_reference_leaves_out_methods_for_other_rooms() -> None:
    left_out = {parameter.id for parameter in _left_out()}
    assert {"Lock.add", "Stream.hear", "Run.fail", "Container.abandon", "Resource.latch"} <= left_out


def test_public_names_are_sorted_and_complete() -> None:
    assert list(trade.__all__) == sorted(trade.__all__)
    public = {
        name
        for name, value in vars(trade).items()
        if not name.startswith("_") and (inspect.isclass(value) or inspect.isfunction(value))
    }
    assert public - {"Any", "datetime", "Iterable", "Mapping", "Sequence"} <= set(trade.__all__)


@pytest.mark.realtime
def test_importing_trade_needs_nothing_of_one_operating_system_and_no_hardware(start_program: Any) -> None:
    program = start_program(
        """
        print("clock" in [handle.name for handle in trade.services()], flush=True)
        """,
        prelude="""
import sys
for name in ("termios", "fcntl", "tty", "pty", "pwd", "grp", "resource", "msvcrt", "winreg", "serial", "can"):
    sys.modules[name] = None  # importing it fails, as where there is none
import os
os.environ["USER"] = "tester"
import trade
""",
    )
    assert program.heard() == "True"
    assert program.ends() == 0
    assert program.errors() == ""


def test_the_package_is_typed() -> None:
    from importlib.resources import files

    assert (files("trade") / "py.typed").is_file()
