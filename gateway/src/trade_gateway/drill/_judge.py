"""The judge of a drill: what the simulator's log says of who moves, and since when who rests."""

from pathlib import Path

import msgspec

__all__ = ["Judge"]


class _Event(msgspec.Struct, frozen=True):
    """What is needed of a line of the byte log."""

    t: float
    name: str = ""
    joint: str = ""


class Judge:
    """Reads a byte log while it is written, each line once.

    Args:
        log: the file.
    """

    def __init__(self, log: Path) -> None:
        self._log = log
        self._at = 0
        self._decoder = msgspec.json.Decoder(_Event)
        self._moves: dict[str, list[tuple[float, bool]]] = {}

    def look(self) -> None:
        """Read what is new."""
        with self._log.open("rb") as file:
            file.seek(self._at)
            whole, ended, _ = file.read().rpartition(b"\n")
        self._at += len(whole) + len(ended)
        for line in whole.splitlines():
            if b'"motion_started"' in line or b'"at_rest"' in line:
                event = self._decoder.decode(line)
                self._moves.setdefault(event.joint, []).append((event.t, event.name == "motion_started"))

    def moves(self, joint: str, at: float | None = None) -> bool:
        """Whether it moved at that time on CLOCK_MONOTONIC; without one, as far as was looked."""
        known = [moving for t, moving in self._moves.get(joint, []) if at is None or t <= at]
        return bool(known) and known[-1]

    def rested(self, joint: str) -> float:
        """When it came to rest last; KeyError: it never did."""
        times = [t for t, moving in self._moves.get(joint, []) if not moving]
        if not times:
            raise KeyError(joint)
        return times[-1]

    def began(self, joint: str, since: float) -> float | None:
        """When it first began to move after that time; None: it did not."""
        return next((t for t, moving in self._moves.get(joint, []) if moving and t > since), None)
