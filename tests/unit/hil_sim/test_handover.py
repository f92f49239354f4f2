"""The example of a behaviour with two arms and its unit test: both are short, pass, and are typed without ``Any``."""

import shutil
from pathlib import Path
from typing import Final

import pytest

from tests.support.pytest_runs import run_pytest
from tests.support.type_checkers import CHECKERS, checked

EXAMPLES: Final = Path(__file__).parents[3] / "examples"
FILES: Final = (EXAMPLES / "handover.py", EXAMPLES / "test_handover.py")
_MOST_LINES: Final = 59


@pytest.mark.realtime
def test_the_test_of_the_handover_passes(tmp_path: Path) -> None:
    shutil.copy(FILES[0], tmp_path)
    assert "3 passed" in run_pytest(tmp_path, FILES[1].read_text(encoding="utf-8"))


@pytest.mark.realtime
@pytest.mark.parametrize("checker", CHECKERS)
def test_type_checkers_find_nothing_in_the_handover(checker: str, tmp_path: Path) -> None:
    for file in FILES:
        shutil.copy(file, tmp_path)
    folder = tmp_path / "settings"
    folder.mkdir()
    found, report = checked(checker, [tmp_path / file.name for file in FILES], folder)
    assert found == [], report


def test_the_handover_and_its_test_are_short_and_have_no_any() -> None:
    lines = [line for file in FILES for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
    assert len(lines) <= _MOST_LINES
    assert not [line for line in lines if "Any" in line or "cast" in line or "type: ignore" in line]
