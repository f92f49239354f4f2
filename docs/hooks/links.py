"""Docstrings name other parts in backticks: on the reference pages these are links."""

import re
from typing import Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

import trade
from trade import errors

_ERRORS: Final = "|".join(errors.__all__)
_CLASSES: Final = "|".join(name for name in trade.__all__ if name[0].isupper())
_NAMED: Final = re.compile(
    rf"<code>(?:(?:trade\.)?(?:errors\.)?(?P<error>{_ERRORS})|(?:trade\.)?(?P<part>(?:{_CLASSES})(?:\.[a-z]\w*)*))</code>"
)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn `Container.find` and `DeviceSilent` into links to them."""
    return _NAMED.sub(_linked, html) if page.file.src_uri.startswith("reference/") else html


def _linked(found: re.Match[str]) -> str:
    name = f"trade.errors.{found['error']}" if found["error"] else f"trade.{found['part']}"
    return f'<autoref identifier="{name}" optional>{found[0]}</autoref>'
