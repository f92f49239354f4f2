"""The tutorials, done as they are read: each file saved, each command typed, each answer compared.

A page's ``console`` blocks are typed in order, in a folder of its own with a copy of examples/. Blocks with a title are
files to save. A command that ends in ``&`` runs beside the others; of what it says as many lines as the page shows
are compared. `kill %1` ends the first of those. Their numbers are those of a shell: one that has ended leaves its own.
"""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import psutil
import pytest

from tests.system.conftest import ROOT
from tests.system.terminals import Shell, end_all_but, normalised

PAGES: Final = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
_TYPED: Final = r"console\n(?P<typed>.*?)"
_SAVED: Final = r'\w+ title="(?P<name>[\w.]+)"\n(?P<text>.*?)'
_BLOCK: Final = re.compile(rf"^```(?:{_TYPED}|{_SAVED})^```$", re.MULTILINE | re.DOTALL)
_COMMAND: Final = re.compile(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", re.MULTILINE)
_LAST: Final = r"Ctrl-C leaves|\"ready\":true|: up$|holding|listening"
"""What background programs of the tutorials say last before they wait."""


class Terminal:
    """A shell, and what is typed into it as the page has it."""

    def __init__(self, shell: Shell) -> None:
        self._shell = shell
        self._jobs: dict[int, subprocess.Popen[str]] = {}

    def save(self, name: str, text: str) -> None:
        (self._shell.folder / name).write_text(text, encoding="utf-8")

    def type(self, command: str) -> str:
        """What a command says, errors too; what differs from run to run in words."""
        if job := re.fullmatch(r"kill %(\d)", command):
            self._shell.end(self._jobs.pop(int(job[1])))
            said = ""
        elif command.endswith(" &"):
            number = max(self._jobs, default=0) + 1
            self._jobs[number] = self._shell.start(command[:-2])
            said = self._shell.heard(self._jobs[number], _LAST)
        else:
            _, said = self._shell.run(command)
        said = said.replace(str(self._shell.folder), "/home/you")
        said = re.sub(r"^\d\d:\d\d:\d\d ", "", said, flags=re.MULTILINE)
        said = re.sub(r"^warning: this host forwards packets.*\n", "", said, flags=re.MULTILINE)  # some CI does
        said = re.sub(r"since \d\d:\d\d:\d\d", "since TIME", said)
        said = re.sub(r"e-stop [0-9a-f]{8}|--clear [0-9a-f]{8}", lambda found: f"{found[0].rsplit(' ', 1)[0]} ID", said)
        return normalised(said, numbers="status" not in command) if said else ""


@pytest.fixture
def terminal(system: str, tmp_path: Path) -> Iterator[Terminal]:
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    with ExitStack() as undo:
        undo.callback(end_all_but, set(psutil.pids()))
        yield Terminal(Shell(tmp_path, undo, COLUMNS="180", TRADE_SYSTEM="home"))


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_matches_the_behaviour(terminal: Terminal, page: Path) -> None:
    """With WRITE_TABLES=1 in the environment the answers on the page are written again."""
    before = page.read_text(encoding="utf-8")

    def done(block: re.Match[str]) -> str:
        if block["name"]:
            terminal.save(block["name"], block["text"])
            return block[0]
        typed = _COMMAND.sub(lambda found: f"$ {found[1]}\n{terminal.type(found[1])}", block["typed"])
        return f"```console\n{typed}```"

    after = _BLOCK.sub(done, before)
    assert "Traceback" not in after
    if os.environ.get("WRITE_TABLES"):
        page.write_text(after, encoding="utf-8")
        return
    assert after == before


def test_every_block_of_a_tutorial_is_typed_or_saved() -> None:
    assert PAGES
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert text.count("\n```") == 2 * len(_BLOCK.findall(text)), page.name
