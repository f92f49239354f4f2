"""What a camera sees of a simulated robot: each device in a field of the picture of its own, as a PNG file. Pure.

A joint is a limb that turns about the middle of its field: 0 rad points to the right, positive angles turn it
counter-clockwise. A gripper is two fingers, at their real distance, and the object between them. An arm has a field
for each of its joints.
"""

import struct
import zlib
from collections.abc import Iterator, Sequence
from math import ceil, cos, sin, sqrt
from typing import Final, NamedTuple

from trade_hil_sim.mechanics._truth import BusState, GripperTruth

Colour = tuple[int, int, int]

BACKGROUND: Final[Colour] = (24, 26, 30)
FLOOR: Final[Colour] = (52, 56, 64)
LIMB: Final[Colour] = (240, 200, 60)
OBJECT: Final[Colour] = (220, 60, 50)
_SPAN_M: Final = 0.12
"""Width in metres that a gripper's field shows."""

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_TRUECOLOUR_8: Final = bytes((8, 2, 0, 0, 0))
"""Bit depth, colour type, compression, filter method, no interlace."""


class Field(NamedTuple):
    """Part of a picture, in pixels from its upper left."""

    left: int
    top: int
    width: int
    height: int


def fields(buses: Sequence[BusState], width_px: int, height_px: int) -> dict[str, Field]:
    """The field of each device, by its name in the robot file; the joints of an arm are ``right.0`` to ``right.5``."""
    names = [name for name, _ in _seen(buses)]
    columns = max(1, ceil(sqrt(len(names))))
    rows = max(1, ceil(len(names) / columns))
    wide, high = width_px // columns, height_px // rows
    return {name: Field(at % columns * wide, at // columns * high, wide, high) for at, name in enumerate(names)}


def draw(buses: Sequence[BusState], width_px: int, height_px: int) -> bytearray:
    """The picture: three bytes a pixel, row by row from the upper left."""
    canvas = _Canvas(width_px, height_px)
    places = fields(buses, width_px, height_px)
    for name, seen in _seen(buses):
        if isinstance(seen, GripperTruth):
            _draw_gripper(canvas, places[name], seen)
        else:
            _draw_joint(canvas, places[name], seen)
    return canvas.rgb


def _seen(buses: Sequence[BusState]) -> Iterator[tuple[str, float | GripperTruth]]:
    """Joints by their angle in rad, and grippers."""
    for bus in buses:
        yield from ((device.joint, device.position_rad) for device in bus.devices)
        yield from ((gripper.gripper, gripper) for gripper in bus.grippers)
        for arm in bus.arms:
            yield from ((f"{arm.arm}.{at}", angle) for at, angle in enumerate(arm.positions_rad))


class _Canvas:
    def __init__(self, width_px: int, height_px: int) -> None:
        self.width, self.height = width_px, height_px
        self.rgb = bytearray(bytes(BACKGROUND) * (width_px * height_px))

    def box(self, left: float, top: float, width: float, height: float, colour: Colour) -> None:
        """Fill a rectangle, as far as it is in the picture."""
        first, last = max(0, round(left)), min(self.width, round(left + width))
        for y in range(max(0, round(top)), min(self.height, round(top + height))):
            if last > first:
                at = 3 * (y * self.width + first)
                self.rgb[at : at + 3 * (last - first)] = bytes(colour) * (last - first)


def _draw_joint(canvas: _Canvas, field: Field, angle_rad: float) -> None:
    centre_x, centre_y = field.left + field.width / 2, field.top + field.height / 2
    reach = 0.42 * min(field.width, field.height)
    thick = max(2.0, reach / 8)
    canvas.box(centre_x - reach / 3, centre_y - reach / 3, 2 * reach / 3, 2 * reach / 3, FLOOR)
    steps = max(1, round(2 * reach))
    for step in range(steps + 1):
        out = reach * step / steps
        x, y = centre_x + out * cos(angle_rad), centre_y - out * sin(angle_rad)
        canvas.box(x - thick / 2, y - thick / 2, thick, thick, LIMB)


def _draw_gripper(canvas: _Canvas, field: Field, gripper: GripperTruth) -> None:
    scale = field.width / _SPAN_M
    centre, thick = field.left + field.width / 2, max(2.0, field.width / 24)
    top, high = field.top + 0.25 * field.height, 0.5 * field.height
    if gripper.object_m is not None:
        wide = min(gripper.object_m, gripper.width_m) * scale if gripper.holding else gripper.object_m * scale
        canvas.box(centre - wide / 2, top + 0.25 * high, wide, 0.5 * high, OBJECT)
    canvas.box(centre - gripper.width_m * scale / 2 - thick, top, thick, high, LIMB)
    canvas.box(centre + gripper.width_m * scale / 2, top, thick, high, LIMB)


def png(rgb: bytes | bytearray, width_px: int, height_px: int) -> bytes:
    """A PNG file of these pixels (ISO/IEC 15948): truecolour, 8 bits, no filter.

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
