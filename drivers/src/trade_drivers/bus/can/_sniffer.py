"""Who talks on a bus by itself, to be heard before anything is said: what asks one kind of device commands another.

Sources: ODrive documentation, "CANSimple protocol" (heartbeat); CiA 301 (error control).
"""

from collections.abc import Mapping, Sequence
from typing import Final

__all__ = ["Talk"]

_BEAT: Final = 0x01
"""The low five bits of an ODrive's heartbeat; the others are its node."""
_BEAT_SIZE: Final = 8
_MOST_STATE: Final = 14
_MOST_RESULT: Final = 14
_ERROR_CONTROL: Final = 0x700
"""Added to the node of a CANopen device, which tells its state in one byte."""
_STATES: Final = frozenset({0x00, 0x04, 0x05, 0x7F})
_NODE: Final = 0x7F


class Talk:
    """What was heard, by identifier."""

    def __init__(self, frames: Mapping[int, Sequence[bytes]]) -> None:
        self.frames = frames

    @property
    def canopen(self) -> frozenset[int]:
        """Nodes of CANopen that tell their state."""
        return frozenset(
            can_id & _NODE
            for can_id, frames in self.frames.items()
            if can_id & ~_NODE == _ERROR_CONTROL and all(len(data) == 1 and data[0] in _STATES for data in frames)
        )

    @property
    def odrives(self) -> dict[int, bytes]:
        """Nodes of ODrives, and the last heartbeat of each.

        The measurements of a CANopen node may have such an identifier and look alike: where one has told its state,
        they are taken for its own.
        """
        theirs = self.canopen
        return {
            can_id >> 5: frames[-1]
            for can_id, frames in self.frames.items()
            if can_id & 0x1F == _BEAT and can_id & _NODE not in theirs and len(frames) > 1 and all(map(_beats, frames))
        }


def _beats(data: bytes) -> bool:
    if len(data) != _BEAT_SIZE:
        return False
    state, result, flags, last = data[4:]
    return state <= _MOST_STATE and result <= _MOST_RESULT and flags <= 1 and last == 0
