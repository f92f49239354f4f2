"""Reads a TOML file, and finds the lines of its tables and keys for errors."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade.toml_files import read_toml_text

_HEADER: Final = re.compile(r"\s*\[\s*([^\[\]]+?)\s*\]\s*(?:#.*)?$")
_NAME: Final = re.compile(r"""["']([^"']*)["']|([\w-]+)""")


def read_toml(path: Path) -> tuple[str, dict[str, Any]]:
    """Reads a TOML file; returns its text and its contents. Raises ConfigurationError."""
    try:
        text = read_text(path)
        return text, read_toml_text(text)
    except FileNotFoundError:
        raise ConfigurationError(where=str(path), problem="there is no such file") from None
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad.strerror}") from None
    except ValueError as bad:  # no TOML, or no UTF-8
        raise ConfigurationError(where=str(path), problem=f"not valid TOML: {bad}") from None


def at(path: Path, text: str, table: tuple[str, ...], key: str) -> str:
    """Returns a place in a file, for errors."""
    return f"{path}:{line_of(text, table, key)}: {'.'.join((*table, key) if key else table)}"


def line_of(text: str, table: Sequence[str], key: str = "") -> int:
    """Returns the line of a key in a table of a TOML text; else of the table's header; else 1."""
    inside, found = False, 1
    wanted = re.compile(rf"""\s*["']?{re.escape(key)}["']?\s*=""")
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            names = [quoted or bare for quoted, bare in _NAME.findall(header.group(1))]
            inside = names[: len(table)] == list(table)
            found = number if inside and found == 1 else found
        elif inside and key and wanted.match(line):
            return number
    return found
