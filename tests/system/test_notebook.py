"""The notebook among the examples runs without hardware and without Jupyter, and shows tables."""

import json
import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest

from tests.system.conftest import ROOT
from tests.system.terminals import Shell, end_all_but

NOTEBOOK = ROOT / "examples" / "notebook.ipynb"
CELLS = Path(__file__).with_name("notebook_cells.py")


@pytest.fixture
def shell(system: str, tmp_path: Path) -> Iterator[Shell]:
    shutil.copy(ROOT / "examples" / "head.toml", tmp_path)
    with ExitStack() as undo:
        undo.callback(end_all_but, set(psutil.pids()))
        yield Shell(tmp_path, undo, TRADE_SYSTEM=system)


def test_the_cells_of_the_notebook_run_and_show_tables(shell: Shell) -> None:
    code, said = shell.run(f"{sys.executable} {CELLS} {NOTEBOOK}")
    assert code == 0, said
    shown = [json.loads(line) for line in said.splitlines() if line.startswith('{"source"')]
    by_source = {cell["source"].splitlines()[-1]: cell for cell in shown}
    assert "<td>rosie.head.move_to</td>" in by_source['trade.services("rosie.head")']["html"]
    assert by_source["trade.containers()"]["html"].count("<tr>") == 3
    assert by_source["lock"]["text"] == "<Lock of rosie.head, not held>"
    assert "<td>look left</td>" in by_source["held"]["html"]
    assert by_source["head"]["text"].startswith("<GroupView rosie.head: ")
    assert "rosie.neck.pan: 3 rad is outside -1.4 to 1.4 rad" in said


def test_the_notebook_is_saved_without_outputs() -> None:
    cells = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert [cell["outputs"] for cell in cells] == [[]] * len(cells)
    assert {cell["execution_count"] for cell in cells} == {None}
