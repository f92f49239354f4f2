"""What the pages say is there, is there; what they show, runs."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from trade import errors
from trade_hil_sim import SimProcess, events

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_the_readme_program_does_what_it_says(system: str, tmp_path: Path) -> None:
    [program] = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    *lines, last = program.strip().splitlines()
    path = tmp_path / "program.py"
    path.write_text("\n".join([*lines[:-1], f"print({lines[-1].split('#')[0]})", last]), encoding="utf-8")
    ended = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=60, check=False)
    assert ended.stdout.strip() == "True"
    said = last.split("# ", 1)[1]
    assert said in ended.stderr.splitlines()[-1].removeprefix("trade.errors.")


def test_the_guide_on_locks_and_stops_does_what_it_says(system: str, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "guide.md").read_text(encoding="utf-8")
    section = page.split("## Locks, stops, e-stop")[1].split("\n## ")[0]
    program = "\n".join(re.findall(r"```python\n(.*?)```", section, re.DOTALL))
    path = tmp_path / "program.py"
    path.write_text(program, encoding="utf-8")
    ended = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines() == re.findall(r"print\(.*\) +# (.*)", program)


def test_no_merge_was_left_half_done() -> None:
    texts = [*PAGES, *ROOT.glob("*.md"), *ROOT.glob("examples/*"), ROOT / "Makefile", ROOT / ".ci" / "run"]
    marks = re.compile(r"^(<<<<<<<|>>>>>>>)( |$)", re.MULTILINE)
    assert not [str(path) for path in texts if path.is_file() and marks.search(path.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_tests_named_in_the_pages_exist() -> None:
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    tests += "\n".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "drivers/src/trade_drivers/testing").glob("*.py")
    )
    named = {name for page in PAGES for name in re.findall(r"`(test_\w+)`", page.read_text(encoding="utf-8"))}
    missing = sorted(name for name in named if f"def {name}" not in tests)
    assert not missing


def test_every_error_is_in_the_guides_table() -> None:
    rows = re.findall(r"^\| (`\w+`.*?) \|", (ROOT / "docs" / "guide.md").read_text(encoding="utf-8"), re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    branches = {"TradeError", "CallerError", "CallError", "DeviceError", "SetupError"}
    assert set(errors.__all__) - branches - named == set()


def test_the_command_for_the_simulator_strikes_it() -> None:
    page = (ROOT / "docs" / "simulators.md").read_text(encoding="utf-8")
    [command] = re.findall(r"```sh\n(python .*?)\n```", page)
    with SimProcess(ROOT / "examples" / "head.toml") as sim:
        words = [sys.executable, *shlex.split(command)[1:-1], str(sim.control_path)]
        subprocess.run(words, timeout=60, check=True)
        assert events(sim.entries(), "brown_out", device_id=1)
