"""Reads TOML, in the same way on every Python, and says what of it does not fit its type."""

import re
import sys
from typing import Any, Final, NamedTuple

import msgspec

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

_AT: Final = re.compile(r" - at `\$\.?([^`]*)`$")
_MISSING: Final = re.compile(r"missing required field `([^`]*)`")
_UNKNOWN: Final = re.compile(r"contains unknown field `([^`]*)`")


class Mismatch(NamedTuple):
    """Why a value does not fit its type."""

    place: str
    """Where, such as ``do[0].args``; empty: at the top. The checker writes ``[...]`` for a name of a mapping."""
    problem: str
    """What is wrong there, in the checker's words."""
    missing: str
    """The key that the place lacks, or an empty text."""
    unknown: str
    """The key that the place should not have, or an empty text."""


def mismatch(error: msgspec.ValidationError) -> Mismatch:
    """Returns what the text of a checker's error says."""
    message = str(error)
    at, missing, unknown = _AT.search(message), _MISSING.search(message), _UNKNOWN.search(message)
    return Mismatch(
        at.group(1) if at else "",
        message[: at.start()] if at else message,
        missing.group(1) if missing else "",
        unknown.group(1) if unknown else "",
    )


def read_toml_text(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: the text is not TOML, or is nested too deeply.
    """
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
