"""Text files of users: a byte-order mark is no part of their text, and it stays with their line ends."""

import codecs
import difflib
from pathlib import Path
from typing import Final

_OTHERS: Final = {
    codecs.BOM_UTF32_LE: "UTF-32",
    codecs.BOM_UTF32_BE: "UTF-32",
    codecs.BOM_UTF16_LE: "UTF-16",
    codecs.BOM_UTF16_BE: "UTF-16",
}


def read_text(path: Path) -> str:
    """Returns the text of a file in UTF-8, as ``as_text``. Raises OSError or UnicodeDecodeError."""
    return as_text(path.read_bytes())


def as_text(data: bytes) -> str:
    r"""Returns a text in UTF-8 without its byte-order mark, and with ``\n`` as the end of each line.

    Raises:
        UnicodeDecodeError: it is not UTF-8. If its byte-order mark is that of UTF-16 or UTF-32, the error says so.
    """
    for mark, name in _OTHERS.items():
        if data.startswith(mark):
            reason = f"it has the byte-order mark of {name}; save it as UTF-8"
            raise UnicodeDecodeError("utf-8", data, 0, len(mark), reason)
    return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def as_before(before: bytes, text: str) -> bytes:
    r"""Returns a new text for a file with the byte-order mark and the line ends that the file has.

    Args:
        before: the contents of the file.
        text: its new text, with ``\n`` or ``\r\n`` at the ends of lines. New lines end like most lines of the file.
    """
    *old, _ = before.removeprefix(codecs.BOM_UTF8).decode().split("\n")
    *new, rest = text.replace("\r\n", "\n").split("\n")
    ends = ["\r\n" if line.endswith("\r") else "\n" for line in old]
    found = [max(ends, key=ends.count, default="\n")] * len(new)
    lines = [line.removesuffix("\r") for line in old]
    for old_at, new_at, size in difflib.SequenceMatcher(None, lines, new, autojunk=False).get_matching_blocks():
        found[new_at : new_at + size] = ends[old_at : old_at + size]
    data = "".join(line + end for line, end in zip(new, found, strict=True)).encode() + rest.encode()
    return codecs.BOM_UTF8 + data if before.startswith(codecs.BOM_UTF8) else data
