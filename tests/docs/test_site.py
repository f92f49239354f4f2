"""The site that `make docs` builds: whole, without a dead link, and of nothing that is elsewhere."""

import importlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
REFERENCE = {"trade": "trade", "trade_drivers": "drivers", "trade_hil_sim": "simulators"}
"""Packages, and the pages that name each of their parts; of others a page shows the whole module."""
DECISIONS = DOCS / "decisions"


class Link(NamedTuple):
    tag: str
    to: str


class Page(HTMLParser):
    """What a page links to and loads, and what in it can be linked to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[Link] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = dict(attrs)
        self.anchors |= {known[name] or "" for name in ("id", "name") if name in known}
        self.links += [Link(tag, known[name] or "") for name in ("href", "src") if name in known]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Page]:
    if sys.version_info < (3, 11):
        pytest.skip("what renders the reference needs Python 3.11 or later")
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(
        words,
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    return {path: Page(path) for path in folder.rglob("*.html")}


@pytest.mark.slow
@pytest.mark.timeout(300)  # 15 s of a processor
def test_the_site_has_all_pages_and_each_link_leads_somewhere(site: dict[Path, Page]) -> None:
    names = {path.stem for path in site}
    assert {path.stem for path in DOCS.rglob("*.md")} - {"README"} <= names
    assert not sorted(_dead(site))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_site_loads_nothing_from_elsewhere(site: dict[Path, Page]) -> None:
    loaded = {link.to for page in site.values() for link in page.links if link.tag in ("script", "link", "img")}
    assert loaded
    assert not [to for to in loaded if urlsplit(to).netloc]


def _dead(site: dict[Path, Page]) -> Iterator[str]:
    for path, page in site.items():
        for _, to in page.links:
            parts = urlsplit(to)
            if parts.scheme or parts.netloc or path.name == "404.html":
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            anchor = unquote(parts.fragment)
            if not target.exists() or (anchor and target in site and anchor not in site[target].anchors):
                yield f"{path.name}: {to}"


@pytest.mark.parametrize("package", REFERENCE)
def test_the_reference_has_every_public_name_once(package: str) -> None:
    text = (DOCS / "reference" / f"{REFERENCE[package]}.md").read_text(encoding="utf-8")
    public = {name for name in importlib.import_module(package).__all__ if name != "errors"}
    assert sorted(re.findall(rf"^(?::::|###) {package}\.(\w+)$", text, re.MULTILINE)) == sorted(public)


def test_decisions_are_in_their_index_by_number_and_title() -> None:
    """With WRITE_TABLES=1 in the environment the index is written again."""
    index = DECISIONS / "README.md"
    text = index.read_text(encoding="utf-8")
    head = text[: text.index("|---|---|\n") + len("|---|---|\n")]
    expected = head + "".join(map(_row, sorted(DECISIONS.glob("0*.md"))))
    if os.environ.get("WRITE_TABLES"):
        index.write_text(expected, encoding="utf-8")
        return
    assert text == expected


def test_each_decision_has_one_topic() -> None:
    topics = (DECISIONS / "README.md").read_text(encoding="utf-8").partition("## By number")[0]
    assert sorted(re.findall(r"\((\d{4}-[^)]+)\)", topics)) == sorted(path.name for path in DECISIONS.glob("0*.md"))


def _row(decision: Path) -> str:
    title = re.match(r"# (\d+)\. (.+)\n", decision.read_text(encoding="utf-8"))
    assert title, f"{decision.name} begins with '# NUMBER. TITLE'"
    number = decision.name[:4]
    assert int(number) == int(title[1]), f"{decision.name} says it is {title[1]}"
    return f"| [{int(number)}]({decision.name}) | {title[2]} |\n"
