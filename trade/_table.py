"""Lists that show themselves as tables, in shells and in notebooks."""

from collections.abc import Iterable, Mapping
from html import escape
from operator import attrgetter
from typing import Final, TypeVar

_T = TypeVar("_T")
_GAP: Final = "  "


class Table(list[_T]):
    """A list that shows itself as a table: as text in a shell, as HTML in a notebook.

    It compares and iterates like any other list. A part of it, such as ``services[:3]``, is a plain list.
    """

    def __init__(self, items: Iterable[_T] = (), columns: Mapping[str, str] | None = None) -> None:
        """Fills the list.

        Args:
            items: its members.
            columns: by header, the attribute of a member that the column shows; dots lead to inner attributes.
        """
        super().__init__(items)
        self._columns = dict(columns or {})

    def __repr__(self) -> str:
        if not self or not self._columns:
            return super().__repr__()
        rows = [tuple(self._columns), *self._rows()]
        widths = [max(map(len, texts)) for texts in zip(*rows, strict=True)]
        return "\n".join(_GAP.join(map(str.ljust, row, widths)).rstrip() for row in rows)

    def _repr_html_(self) -> str:
        """The table as HTML, for notebooks. Its texts are escaped: they came from other containers."""
        head = _html_row("th", self._columns)
        body = "".join(_html_row("td", row) for row in self._rows())
        return f"<table><thead>{head}</thead><tbody>{body}</tbody></table>"

    def _rows(self) -> list[tuple[str, ...]]:
        getters = [attrgetter(path) for path in self._columns.values()]
        return [tuple(_text(get(item)) for get in getters) for item in self]


def _text(value: object) -> str:
    """A value in one line, without control characters."""
    if isinstance(value, float):
        return f"{value:.3g}"
    text = ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    return "".join(one if one.isprintable() else " " for one in text)


def _html_row(tag: str, texts: Iterable[str]) -> str:
    return f"<tr>{''.join(f'<{tag}>{escape(text)}</{tag}>' for text in texts)}</tr>"
