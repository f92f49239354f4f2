"""What the packages' own pages show, which are those of the package index: it runs, and says what they say."""

import re
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest

from tests.docs.blocks import ROOT, blocks
from tests.system.terminals import Shell, end_all_but

pytestmark = pytest.mark.realtime

PACKAGES = ("trade", "drivers", "hil-sim", "robotfile")


def page(folder: str) -> Path:
    return ROOT / folder / "README.md"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the robot file of the drivers' page."""
    [robot_file] = blocks(page("drivers"), "toml")
    (tmp_path / "head.toml").write_text(robot_file.text, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize("package", PACKAGES)
def test_the_program_of_a_package_says_what_its_page_says(package: str, system: str, folder: Path) -> None:
    [program] = blocks(page(package), "python")
    (folder / "program.py").write_text(program.text, encoding="utf-8")
    words = [sys.executable, "program.py"]
    ended = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=100, check=False)
    says = re.findall(r"print\(.*\) +# (.*)", program.text)
    assert says
    assert len(ended.stdout.splitlines()) == len(says), ended.stderr
    assert all(line.startswith(says_) for line, says_ in zip(ended.stdout.splitlines(), says, strict=True))
    raises = re.findall(r"# (\w+: .*)", program.text.splitlines()[-1])
    if raises:
        assert raises[0] in ended.stderr
    else:
        assert ended.returncode == 0, ended.stderr


def test_the_commands_of_the_gateways_page(system: str, folder: Path) -> None:
    [commands] = blocks(page("gateway"), "sh")
    up, *others = commands.text.splitlines()
    with ExitStack() as undo:
        undo.callback(end_all_but, set(psutil.pids()))
        shell = Shell(folder, undo)
        shell.heard(shell.start(up), "Ctrl-C leaves")
        for command in others:
            code, said = shell.run(command)
            assert code == 0, f"{command}: {said}"


@pytest.mark.parametrize("package", [*PACKAGES, "gateway", "checks"])
def test_a_page_has_how_it_is_installed_and_links_that_lead_somewhere(package: str) -> None:
    text = page(package).read_text(encoding="utf-8")
    project = ROOT if package == "trade" else ROOT / package
    name = re.search(r'^name = "(.*)"', (project / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
    assert name
    assert text.startswith(f"# {name[1]}\n")
    assert re.search(rf'pip install "?{name[1]}\b', text)
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text)
    assert links
    assert not [link for link in links if not (ROOT / package / link).exists()]
