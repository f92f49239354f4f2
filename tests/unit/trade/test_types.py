"""mypy and pyright know the types of services: they find each wrong line of a behaviour, and none in the tutorial."""

import re
from pathlib import Path

import pytest

from tests.support.type_checkers import CHECKERS, checked, seeded

ROOT = Path(__file__).parents[3]
BEHAVIOUR = Path(__file__).with_name("typed_behaviour.py")
WRONG = seeded(BEHAVIOUR)
TUTORIAL = ROOT / "docs" / "tutorials" / "programmer.md"


def saved(folder: Path) -> list[Path]:
    """The programs of the tutorial, saved as it says."""
    text = TUTORIAL.read_text(encoding="utf-8")
    found: list[Path] = []
    for name, program in re.findall(r'^```python title="(\w+\.py)"\n(.*?)^```', text, re.MULTILINE | re.DOTALL):
        found.append(folder / name)
        found[-1].write_text(program, encoding="utf-8")
    return found


def test_there_is_something_to_find() -> None:
    assert len(WRONG) == 7


@pytest.mark.realtime
@pytest.mark.parametrize("checker", CHECKERS)
def test_each_wrong_line_is_found_and_none_in_the_tutorial(checker: str, tmp_path: Path) -> None:
    cache = tmp_path / "checker"
    cache.mkdir()
    programs = saved(tmp_path)
    assert len(programs) >= 6
    wrong = tmp_path / "seeded.py"
    greeter = (tmp_path / "greeter.py").read_text()
    wrong.write_text(greeter.replace("head.move_to([0.0, -0.2])", 'head.move_to("down")'))
    [line] = [number for number, text in enumerate(wrong.read_text().splitlines(), 1) if '"down"' in text]
    found, said = checked(checker, [BEHAVIOUR, wrong, *programs], cache)
    assert found == sorted([*WRONG, (wrong.name, line)]), said
