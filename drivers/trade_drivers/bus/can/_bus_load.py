"""Bus load: the bits of frames as a share of the bit rate. Pure, with the time as an argument."""

from typing import Final

_WINDOW_NS: Final = 1_000_000_000


def frame_bits(size: int) -> int:
    """Returns the maximum bits of a standard data frame of this size, including the interframe space.

    Source: ISO 11898-1; 47 bits and the data, and one stuffed bit for every four of the 34 + 8 n that can be stuffed.
    """
    return 47 + 8 * size + (33 + 8 * size) // 4


class LoadMeter:
    """The load of the last whole second, as a fraction of the bit rate."""

    def __init__(self, bitrate: int, now_ns: int) -> None:
        self._bitrate = bitrate
        self._since_ns = now_ns
        self._bits = 0
        self.load = 0.0

    def add(self, bits: int, now_ns: int) -> None:
        """Adds bits that went over the bus."""
        self._bits += bits
        self.tick(now_ns)

    def tick(self, now_ns: int) -> None:
        """Advances the time."""
        elapsed_ns = now_ns - self._since_ns
        if elapsed_ns >= _WINDOW_NS:
            self.load = self._bits * 1e9 / elapsed_ns / self._bitrate
            self._since_ns, self._bits = now_ns, 0
