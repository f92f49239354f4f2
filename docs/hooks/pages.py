"""The pages of the site: those in docs/, README.md as the first, and every file of the repository that a page links to.

On the site a file has the path it has in the repository; what is in docs/ has it without that, and README.md is
index.md. Pages are written for GitHub: their links are turned into the site's.
"""

import os
import re
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT: Final = Path(__file__).parents[2]
DOCS: Final = ROOT / "docs"
FIRST: Final = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
"""Pages outside of docs/ that are also on the site."""
_LINK: Final = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(?=\))")
_CODE: Final = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files outside of docs/ that are linked to, and those that they link to."""
    left = [ROOT / name for name in FIRST]
    left += [target for file in files.documentation_pages() for target in _targets(Path(file.abs_src_path or ""))]
    while left:
        path = left.pop()
        uri = site_uri(path)
        if path.is_relative_to(DOCS) or files.get_file_from_path(uri):
            continue
        files.append(File.generated(config, uri, abs_src_path=str(path)))
        left += _targets(path) if path.suffix == ".md" else ()
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Have the links of a page lead to where their targets are on the site."""
    if page.file.src_uri == "index.md":
        page.meta["hide"] = ["navigation"]
    if page.file.src_uri.startswith("decisions/"):
        page.meta["search"] = {"boost": 0.3}  # found, but below what one does with it
    here = _source(page.file)
    if here is None:
        return markdown

    def turned(found: re.Match[str]) -> str:
        target = _target(here, found[2])
        if target is None:
            return found[0]
        uri = os.path.relpath(site_uri(target), Path(page.file.src_uri).parent)
        return f"{found[1]}{uri}{found[3] or ''}"

    return _outside_code(markdown, turned)


def site_uri(path: Path) -> str:
    """Where a file of the repository is on the site."""
    if path == ROOT / "README.md":
        return "index.md"
    return path.relative_to(DOCS if path.is_relative_to(DOCS) else ROOT).as_posix()


def _outside_code(markdown: str, turned: Callable[[re.Match[str]], str]) -> str:
    ends = [0, *(end for found in _CODE.finditer(markdown) for end in found.span()), len(markdown)]
    parts = [markdown[a:b] for a, b in pairwise(ends)]
    return "".join(part if at % 2 else _LINK.sub(turned, part) for at, part in enumerate(parts))


def _targets(page: Path) -> Iterator[Path]:
    for found in _LINK.finditer(_CODE.sub("", page.read_text(encoding="utf-8")) if page.is_file() else ""):
        if (target := _target(page, found[2])) is not None:
            yield target


def _target(page: Path, link: str) -> Path | None:
    """The file that a link leads to; of a folder its README.md."""
    path = (page.parent / link).resolve()
    path = path / "README.md" if path.is_dir() else path
    return path if path.is_file() and path.is_relative_to(ROOT) else None


def _source(file: File) -> Path | None:
    path = Path(file.abs_src_path) if file.abs_src_path else None
    return path if path is not None and path.is_relative_to(ROOT) else None
