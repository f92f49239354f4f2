"""A CAN frame: what is in it, when it wins the wire, and how long it holds it. Pure."""

import re
from dataclasses import dataclass
from typing import Final

TAIL_BITS: Final = 13
"""CRC delimiter, acknowledge, end of frame, pause between frames (ISO 11898-1, 10.4): never stuffed."""
CRC_BITS: Final = 15
RUN: Final = re.compile("0{5}|1{5}")
"""Five equal bits, after which the sender stuffs one."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A classic CAN frame."""

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    """Whether it asks for data; it carries none."""
    length: int = 0
    """The number of bytes that a remote frame requests."""

    @property
    def rank(self) -> tuple[int, bool, int, bool]:
        """Arbitration: of frames that begin at once, the one of the lowest rank gets through."""
        if self.extended:
            return self.can_id >> 18, True, self.can_id & 0x3FFFF, self.remote
        return self.can_id, False, 0, self.remote

    @property
    def bits(self) -> int:
        """Bit times on the wire, from the start of frame to the end of the pause after it.

        Stuffed bits are counted in header and data, not in the check sum, which has less than one on average.
        """
        length = self.length if self.remote else len(self.data)
        name = f"{self.can_id >> 18:011b}11{self.can_id & 0x3FFFF:018b}" if self.extended else f"{self.can_id:011b}"
        body = f"0{name}{self.remote:b}00{length:04b}"
        if self.data:
            body += f"{int.from_bytes(self.data, 'big'):0{8 * len(self.data)}b}"
        return len(body) + len(RUN.findall(body)) + CRC_BITS + TAIL_BITS

    def __str__(self) -> str:
        name = f"{self.can_id:08X}" if self.extended else f"{self.can_id:03X}"
        return f"{name}#{'R' if self.remote else ''}{self.data.hex().upper()}"
