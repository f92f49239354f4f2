"""Reads TOML, in the same way on every Python."""

import sys
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]


def read_toml_text(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: the text is not TOML, or is nested too deeply.
    """
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
