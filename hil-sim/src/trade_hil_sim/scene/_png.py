"""Pixels to a PNG file (ISO/IEC 15948): truecolour, 8 bits, no filter. Pure."""

import struct
import zlib
from typing import Final

__all__ = ["png"]

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_TRUECOLOUR_8: Final = bytes((8, 2, 0, 0, 0))
"""Bit depth, colour type, compression, filter method, no interlace."""


def png(rgb: bytes | bytearray, width_px: int, height_px: int) -> bytes:
    """A file of these pixels.

    Args:
        rgb: three bytes a pixel, row by row from the upper left.
        width_px: pixels in a row.
        height_px: rows.
    """
    if len(rgb) != 3 * width_px * height_px:
        raise ValueError(f"{len(rgb)} bytes are not {width_px} x {height_px} pixels")
    step = 3 * width_px
    rows = b"".join(b"\0" + rgb[at : at + step] for at in range(0, len(rgb), step))
    size = struct.pack(">II", width_px, height_px)
    parts = (_chunk(b"IHDR", size + _TRUECOLOUR_8), _chunk(b"IDAT", zlib.compress(rows, 1)), _chunk(b"IEND", b""))
    return _SIGNATURE + b"".join(parts)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
