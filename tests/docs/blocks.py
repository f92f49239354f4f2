"""Blocks of code on the pages, each with its heading."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

ROOT: Final = Path(__file__).parents[2]
DOCS: Final = ROOT / "docs"
_HEADING: Final = r"^#+ (?P<heading>[^\n]+)$"
_BLOCK: Final = r"^(?P<indent> *)```(?P<language>\w+)[^\n]*\n(?P<text>.*?)^(?P=indent)```$"
_PART: Final = re.compile(f"{_HEADING}|{_BLOCK}", re.MULTILINE | re.DOTALL)
_Test = TypeVar("_Test", bound=Callable[..., Any])


class Block(NamedTuple):
    """One block of code."""

    heading: str
    """The nearest one above it."""
    line: int
    """The page's line on which its text begins."""
    language: str
    text: str
    """Without the indentation that it has in a list."""


class Section(NamedTuple):
    """The part of a page below one heading."""

    page: str
    """Its path beneath docs/."""
    heading: str

    def blocks(self, *languages: str) -> list[Block]:
        """The blocks in these languages."""
        return [one for one in blocks(DOCS / self.page, *languages) if one.heading == self.heading]


def blocks(page: Path, *languages: str) -> Iterator[Block]:
    """The text of the blocks of code in these languages, also in lists."""
    text = page.read_text(encoding="utf-8")
    heading = ""
    for found in _PART.finditer(text):
        if found["heading"]:
            heading = found["heading"]
        elif found["language"] in languages:
            body = re.sub(rf"^{found['indent']}", "", found["text"], flags=re.MULTILINE)
            yield Block(heading, text.count("\n", 0, found.start("text")) + 1, found["language"], body)


def sections(pages: Iterator[Path], *languages: str) -> set[Section]:
    """Where these pages have blocks in these languages."""
    return {Section(str(page.relative_to(DOCS)), one.heading) for page in pages for one in blocks(page, *languages)}


def of(page: str, heading: str) -> Callable[[_Test], _Test]:
    """Say of a test which section's blocks it runs."""

    def mark(test: _Test) -> _Test:
        test.section = Section(page, heading)  # type: ignore[attr-defined]
        return test

    return mark


def said(tests: dict[str, Any]) -> set[Section]:
    """The sections that the tests of a module say they run."""
    return {test.section for test in tests.values() if hasattr(test, "section")}
