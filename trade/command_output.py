"""Standard error of a ``trade`` command that another process ran, as people read it."""

import msgspec


class _Error(msgspec.Struct):
    error: str
    message: str


def as_text(output: str) -> str:
    """Returns the output with each error in JSON as a line of text: its name and message."""
    return "\n".join(map(_as_text, output.splitlines()))


def last_line(output: str) -> str:
    """Returns the last line with any text, or an empty one."""
    return next((_as_text(line.strip()) for line in reversed(output.splitlines()) if line.strip()), "")


def _as_text(line: str) -> str:
    try:
        found = msgspec.json.decode(line, type=_Error)
    except msgspec.DecodeError:
        return line
    return f"{found.error}: {found.message}"
