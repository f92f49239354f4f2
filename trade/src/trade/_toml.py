"""Reading TOML, on every Python the same."""

import sys
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

__all__ = ["read_toml_text"]


def read_toml_text(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: it is no TOML, or nested deeper than can be read.
    """
    try:
        return tomllib.loads(text)  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
