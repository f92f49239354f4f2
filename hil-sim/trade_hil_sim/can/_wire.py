"""The wire of a CAN bus: one frame at a time, the lowest id first, as long as its bits last. Pure: time is an argument.

Wire time follows real time but is not lengthened by it: a simulator that runs late delivers, in order and with their
own times, the frames that a real wire would have carried meanwhile.
"""

import heapq
from collections.abc import Callable
from math import inf
from typing import Final, NamedTuple, Protocol

from ._frame import Frame

ERROR_BITS: Final = 20
"""Bit times of an error frame and the pause after it."""
PER_ERROR: Final = 8
"""Increase of the sender's error counter per destroyed frame; each sent frame decreases it by 1 (ISO 11898-1)."""
BUS_OFF: Final = 256
UNHEARD: Final = 10
"""How many unacknowledged frames a sender keeps: the usual length of a transmit queue on Linux."""


class _QueuedFrame(NamedTuple):
    ready: float
    order: int
    frame: Frame


class Station:
    """A controller on the bus: a client's or a device's. Frames of one station leave in the order they were sent.

    Args:
        name: for the log.
        device_id: of a device.
        deliver: gets every frame of the others, with its time in seconds.
    """

    def __init__(self, name: str, deliver: Callable[[Frame, float], None], device_id: int | None = None) -> None:
        self.name, self.device_id, self.deliver = name, device_id, deliver
        self.connected = True
        self.off = False
        """Bus-off: after too many errors it neither sends nor receives."""
        self.errors = 0
        """Transmit error counter."""
        self.queue: list[_QueuedFrame] = []

    @property
    def hears(self) -> bool:
        """Whether it takes part."""
        return self.connected and not self.off

    def fall_silent(self) -> None:
        """Discard queued frames."""
        self.queue.clear()


class Referee(Protocol):
    """Decides what happens to frames, and is notified of what did."""

    def corrupts(self, sender: Station, frame: Frame) -> bool:
        """Whether this frame is destroyed on its way."""
        ...

    def passed(self, sender: Station, frame: Frame, t: float) -> None:
        """A frame got through; called before any station receives it."""
        ...

    def destroyed(self, sender: Station, frame: Frame, t: float) -> None:
        """A frame was destroyed; its sender's error counter has been raised."""
        ...

    def lost(self, sender: Station, frame: Frame, t: float) -> None:
        """A frame was rejected: none are acknowledged, and the sender's queue is full."""
        ...


class Wire:
    """What stations send, in the order and at the times a wire allows.

    Args:
        bitrate: bits a second; None: frames take no time.
        referee: decides about frames and is notified of them.
    """

    def __init__(self, bitrate: int | None, referee: Referee) -> None:
        self._bit_s = 0.0 if bitrate is None else 1.0 / bitrate
        self._referee = referee
        self._stations: list[Station] = []
        self._order = 0
        self._free_at = 0.0
        self._under_way: tuple[Station, _QueuedFrame, float] | None = None
        self.busy_s = 0.0
        """How long frames have held the wire, in all."""

    def attach(self, station: Station) -> None:
        """Add a station."""
        self._stations.append(station)

    def detach(self, station: Station) -> None:
        """Remove a station; its unsent frames are lost, and a frame under way is cut off."""
        self._stations.remove(station)
        station.fall_silent()
        if self._under_way is not None and self._under_way[0] is station:
            self._under_way = None

    def send(self, station: Station, frame: Frame, ready: float) -> None:
        """Queue a frame that may begin at `ready` seconds."""
        if not station.hears:
            return
        if len(station.queue) >= UNHEARD and not self._acknowledged(station):
            self._referee.lost(station, frame, ready)
            return
        self._order += 1
        heapq.heappush(station.queue, _QueuedFrame(ready, self._order, frame))

    def next_due(self) -> float:
        """When `advance` should be called next; infinity while nothing is to be sent."""
        if self._under_way is not None:
            return self._under_way[2]
        competing = self._competing()
        return max(self._free_at, min(s.queue[0].ready for s in competing)) if competing else inf

    def advance(self, t: float) -> None:
        """Begin or end the frame that is due at `t`."""
        if self._under_way is None:
            self._begin(t)
        else:
            self._end(*self._under_way)

    def _competing(self) -> list[Station]:
        waiting = [s for s in self._stations if s.queue and s.hears]
        return waiting if waiting and self._acknowledged(waiting[0]) else []

    def _acknowledged(self, station: Station) -> bool:
        return any(other is not station and other.hears for other in self._stations)

    def _begin(self, t: float) -> None:
        ready = [s for s in self._competing() if s.queue[0].ready <= t]
        winner = min(ready, key=lambda s: s.queue[0].frame.rank, default=None)
        if winner is None:
            return
        waiting = heapq.heappop(winner.queue)
        lasts_s = waiting.frame.bits * self._bit_s
        self.busy_s += lasts_s
        self._under_way = winner, waiting, t + lasts_s

    def _end(self, sender: Station, waiting: _QueuedFrame, t: float) -> None:
        self._under_way, self._free_at = None, t
        if not sender.hears:
            return
        if self._referee.corrupts(sender, waiting.frame):
            self._destroy(sender, waiting, t)
            return
        sender.errors = max(0, sender.errors - 1)
        self._referee.passed(sender, waiting.frame, t)
        for station in tuple(self._stations):
            if station is not sender and station.hears:
                station.deliver(waiting.frame, t)

    def _destroy(self, sender: Station, waiting: _QueuedFrame, t: float) -> None:
        """The sender tries again, until it has made too many errors."""
        self._free_at = t + ERROR_BITS * self._bit_s
        sender.errors += PER_ERROR
        heapq.heappush(sender.queue, waiting)
        if sender.errors >= BUS_OFF:
            sender.off = True
            sender.fall_silent()
        self._referee.destroyed(sender, waiting.frame, t)
