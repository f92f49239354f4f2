"""The style checker finds avoided words where people read them, and nowhere else."""

from pathlib import Path

from tests.docs.plain_english import findings

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
