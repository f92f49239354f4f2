"""What the pages name exists, and what they show runs."""

import ast
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import msgspec
import pytest
import typer

from tests.docs.blocks import blocks
from trade import errors
from trade_gateway.cli import build
from trade_hil_sim import AnswerFault, Command, SimProcess, events
from trade_hil_sim.faults._commands import kinds_of

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

KINDS: Final = kinds_of(Command)
ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.realtime
def test_the_readme_program_does_what_it_says(system: str, tmp_path: Path) -> None:
    [program] = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    path, last = tmp_path / "program.py", program.strip().splitlines()[-1]
    path.write_text(program, encoding="utf-8")
    ended = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=60, check=False)
    assert ended.stdout.strip() == "True"
    said = last.split("# ", 1)[1]
    assert said in ended.stderr.splitlines()[-1].removeprefix("trade.errors.")


def test_no_merge_was_left_half_done() -> None:
    texts = [*PAGES, *ROOT.glob("*.md"), *ROOT.glob("examples/*"), ROOT / "Makefile", ROOT / ".ci" / "run"]
    marks = re.compile(r"^(<<<<<<<|>>>>>>>)( |$)", re.MULTILINE)
    assert not [str(path) for path in texts if path.is_file() and marks.search(path.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if ROOT / "docs" in page.parents and page.parent.name != "decisions"],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_each_page_names_its_reader_and_what_they_can_do_after_it(page: Path) -> None:
    title, reader, *_ = page.read_text(encoding="utf-8").split("\n\n")
    assert title.startswith("# ")
    assert re.fullmatch(r"For .*\.\s(It takes \d+ minutes\.\s)?After reading, you (can|know) .*\.", reader, re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_cells_of_tables_are_short(page: Path) -> None:
    prose = re.sub(r"\]\([^)]*\)", "]", page.read_text(encoding="utf-8"))
    rows = [line for line in prose.splitlines() if line.startswith("|")]
    assert not [cell for row in rows for cell in row.split("|") if len(cell.strip()) > 200]


def test_tests_named_in_the_pages_exist() -> None:
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    tests += "\n".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "drivers/trade_drivers/testing").glob("*.py")
    )
    named = {name for page in PAGES for name in re.findall(r"`(test_\w+)`", page.read_text(encoding="utf-8"))}
    missing = sorted(name for name in named if f"def {name}" not in tests)
    assert not missing


def test_every_error_is_in_the_guides_table() -> None:
    rows = re.findall(r"^\| (`\w+`.*?) \|", (ROOT / "docs" / "guide.md").read_text(encoding="utf-8"), re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    branches = {"TradeError", "CallerError", "CallError", "DeviceError", "SetupError"}
    assert set(errors.__all__) - branches - named == set()


@pytest.mark.realtime
def test_the_command_for_the_simulator_strikes_it() -> None:
    page = (ROOT / "docs" / "simulators.md").read_text(encoding="utf-8")
    [command] = re.findall(r"```sh\n(trade-hil-sim --do .*?)\n```", page)
    with SimProcess(ROOT / "examples" / "head.toml") as sim:
        words = [str(sim.control_path) if word.endswith("/_control") else word for word in shlex.split(command)[1:]]
        words = [sys.executable, "-m", "trade_hil_sim", *words]
        subprocess.run(words, timeout=60, check=True)
        assert events(sim.entries(), "brown_out", device_id=1)


@pytest.mark.parametrize("word", KINDS)
def test_the_page_on_the_simulators_has_each_fault_with_its_fields(word: str) -> None:
    page = (ROOT / "docs" / "simulators.md").read_text(encoding="utf-8")
    [cells] = re.findall(rf"^\| (?:`\w+`, )?`{word}`(?:, `\w+`)? \|(.*?)\| ", page, re.MULTILINE)
    reported = dict(re.findall(r"`(\w+)`(?: \((.*?)\))?", cells))
    kind = KINDS[word]
    common = AnswerFault.__struct_fields__ if issubclass(kind, AnswerFault) else ("bus",)
    assert reported.keys() == set(kind.__struct_fields__) - set(common)
    given = msgspec.inspect.type_info(kind)
    assert isinstance(given, msgspec.inspect.StructType)
    for field in given.fields:
        if field.name in reported:
            assert field.required == (f"**`{field.name}`**" in cells)
            default = reported[field.name].strip("`").replace(" ", "")
            assert default == ("" if field.required or field.default is None else json_text(field.default))


def json_text(value: object) -> str:
    return msgspec.json.encode(int(value) if isinstance(value, float) else value).decode()


def commands(page: Path) -> Iterator[list[str]]:
    """The words of each ``trade`` in the blocks of a page, without what precedes and follows it in its line."""
    typed = [line for block in blocks(page, "sh") for line in block.text.splitlines()]
    typed += [line[2:] for block in blocks(page, "console") for line in block.text.splitlines() if line[:2] == "$ "]
    for line in typed:
        if found := re.match(r"(?:sudo (?:-u \w+ )?)?((?:[A-Z_]+=\S+ )*)trade (?!-)", line):
            yield list(until_operator(shlex.split(line[found.end() :], comments=True)))


def until_operator(words: list[str]) -> Iterator[str]:
    """The words up to a pipe, another command, or what goes to a file."""
    for word in words:
        if word in ("|", "&", "&&", "||", ";", ">", "2>", "<", "--"):
            return
        yield word


def unknown(command: Any, words: list[str]) -> str:
    """What of a command line is no command or option; empty if all is."""
    left = list(words)
    while hasattr(command, "commands") and left and not left[0].startswith("-"):
        if left[0] not in command.commands:
            return f"no command {left[0]}"
        command = command.commands[left.pop(0)]
    takes = [command, *getattr(command, "commands", {}).values()]  # a group may have a command that needs no word
    known = {name for one in takes for each in one.params for name in (*each.opts, *each.secondary_opts)}
    given = {word.partition("=")[0] for word in left if re.match(r"--?[a-z]", word)}
    return ", ".join(sorted(given - known - {"--help", "-h"}))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_that_pages_show_exist_with_their_options(page: Path) -> None:
    trade_ = typer.main.get_command(build())
    wrong = [(" ".join(words), said) for words in commands(page) if (said := unknown(trade_, words))]
    assert not wrong


def test_a_command_that_does_not_exist_is_noticed() -> None:
    trade_ = typer.main.get_command(build())
    assert unknown(trade_, ["up", "rosie.toml", "--simulate"])
    assert unknown(trade_, ["go", "up"])
    assert unknown(trade_, ["policy", "chek"])
    assert not unknown(trade_, ["policy", "check", "ann", "lock", "rosie", "--policy", "policy.toml"])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_blocks_of_pages_are_of_their_language(page: Path) -> None:
    for block in blocks(page, "python"):
        compile(block.text, str(page), "exec", ast.PyCF_ONLY_AST | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    for block in blocks(page, "toml"):
        tomllib.loads(block.text)
    for block in blocks(page, "json"):
        json.loads(block.text)
