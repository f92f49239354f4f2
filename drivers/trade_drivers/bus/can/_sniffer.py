"""Listening for traffic before sending, since a request to one kind of device commands another kind.

Sources: ODrive documentation, "CANSimple protocol" (heartbeat); CiA 301 (error control).
"""

from collections.abc import Mapping, Sequence
from typing import Final

_BEAT: Final = 0x01
"""The low five bits of the identifier of an ODrive's heartbeat; the others are its node."""
_BEAT_SIZE: Final = 8
_MOST_STATE: Final = 14
_MOST_RESULT: Final = 14
_ERROR_CONTROL: Final = 0x700
"""Added to the node for the identifier of a CANopen device's heartbeat, which has one byte."""
_STATES: Final = frozenset({0x00, 0x04, 0x05, 0x7F})
_NODE: Final = 0x7F


class FramesById:
    """Received frames by identifier."""

    def __init__(self, frames: Mapping[int, Sequence[bytes]]) -> None:
        self.frames = frames

    @property
    def canopen(self) -> frozenset[int]:
        """The CANopen nodes that send heartbeats."""
        return frozenset(
            can_id & _NODE
            for can_id, frames in self.frames.items()
            if can_id & ~_NODE == _ERROR_CONTROL and all(len(data) == 1 and data[0] in _STATES for data in frames)
        )

    @property
    def odrives(self) -> dict[int, bytes]:
        """The nodes of ODrives with the last heartbeat of each.

        Measurements of a CANopen node may have the same identifier and form. If that node has sent a heartbeat, the
        frames are attributed to it.
        """
        canopen = self.canopen
        return {
            can_id >> 5: frames[-1]
            for can_id, frames in self.frames.items()
            if can_id & 0x1F == _BEAT and can_id & _NODE not in canopen and len(frames) > 1 and all(map(_beats, frames))
        }


def _beats(data: bytes) -> bool:
    if len(data) != _BEAT_SIZE:
        return False
    state, result, flags, last = data[4:]
    return state <= _MOST_STATE and result <= _MOST_RESULT and flags <= 1 and last == 0
