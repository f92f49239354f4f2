"""Format and size of PNG and JPEG files. Pure."""

from typing import Final, Literal, NamedTuple

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_PNG_END: Final = b"IEND\xaeB`\x82"
_JPEG: Final = b"\xff\xd8\xff"
_JPEG_END: Final = b"\xff\xd9"
_JPEG_TRAIL: Final = 64
"""Padding that some cameras append."""
_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a frame header (ITU T.81, table B.1); the three that are left out are other tables."""


class Picture(NamedTuple):
    """Format and size."""

    format: Literal["png", "jpeg"]
    width_px: int
    height_px: int


def picture(data: bytes) -> Picture:
    """Returns format and size of a complete picture.

    Raises:
        ValueError: it is neither PNG nor JPEG, or incomplete.
    """
    if data.startswith(_PNG) and data[12:16] == b"IHDR":
        if not data.endswith(_PNG_END):
            raise ValueError("a PNG that breaks off")
        return Picture("png", int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))
    if data.startswith(_JPEG):
        if _JPEG_END not in data[-_JPEG_TRAIL:]:
            raise ValueError("a JPEG that breaks off")
        return _jpeg(data)
    raise ValueError(f"no PNG and no JPEG: it begins with {data[:8]!r}")


def _jpeg(data: bytes) -> Picture:
    """Searches the segments for the one with the size."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in _FRAMES:
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            return Picture("jpeg", width, height)
        at += 1 if marker == 0xFF else 2 + length
    raise ValueError("a JPEG without a frame header")
