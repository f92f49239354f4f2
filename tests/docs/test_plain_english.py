"""The style checker finds avoided words where people read them, and nowhere else."""

import re
from pathlib import Path

from tests.docs.plain_english import KEPT, PRODUCT, ROOT, files, findings, in_names

PAGE = """# A title

It stands in a queue. A word `told` as code is fine.

```python
told = 1
```

The client is told. <!-- plain: told -->
A letter stands for a number.
"""

MODULE = '''"""Nobody reads this."""

told = "somebody waits"  # for ever
quoted = "Whoever said so"  # plain: Whoever
label = f"{told} goes on"
'''

NAMES = """class NodeTold:
    told_by: str  # plain: told

    def watch(self, theirs: int) -> None:
        self.let_go = said.told

    def test_nobody_waits(self) -> None: ...
"""


def found(path: Path, text: str) -> list[tuple[str, str]]:
    path.write_text(text, encoding="utf-8")
    return [(line.split(":")[1], line.split('"')[1]) for line in findings([path])]


def test_a_page_is_searched_outside_its_code(tmp_path: Path) -> None:
    assert found(tmp_path / "page.md", PAGE) == [("3", "stands")]


def test_a_module_is_searched_in_docstrings_comments_and_messages(tmp_path: Path) -> None:
    words = [("1", "Nobody"), ("3", "for ever"), ("3", "somebody"), ("5", "goes on")]
    assert sorted(found(tmp_path / "module.py", MODULE)) == words


def test_a_finding_says_what_to_write_instead(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("It begins anew.\n", encoding="utf-8")
    assert list(findings([page])) == [f'{page}:1: "anew": use again']


def test_a_module_is_searched_in_the_names_that_it_defines(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text(NAMES, encoding="utf-8")
    assert sorted(line.split('"')[1] for line in in_names(path)) == ["let go", "nobody", "theirs", "told"]


def test_of_a_test_module_the_names_of_tests_are_searched(tmp_path: Path) -> None:
    path = tmp_path / "test_module.py"
    path.write_text(NAMES, encoding="utf-8")
    assert [line.split('"')[1] for line in findings([path])] == ["nobody"]


def test_the_product_needs_each_word_that_is_kept_and_marks_none() -> None:
    for name, word in KEPT:
        assert re.search(rf"(?i)(?<![a-z]){word}", (ROOT / name).read_text(encoding="utf-8"))
    marks = [
        path for path in files([ROOT / part for part in PRODUCT]) if "# plain:" in path.read_text(encoding="utf-8")
    ]
    assert marks == []
