"""A serial line with timing: bytes leave when a real wire would have carried them, and the plug can be pulled.

One thread owns the pty. It never sleeps on an answer that is due later, so a client may speak while one is pending.
"""

import heapq
import os
import select
import time
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from trade_hil_sim.log._byte_log import ByteLog, Kind, LogEntry
from trade_hil_sim.robot._bus_thread import BusThread
from trade_hil_sim.serial._pty import Terminal

BITS_PER_BYTE: Final = 10
"""8N1: start bit, eight data bits, stop bit."""
SPIN_S: Final = 0.0002
"""``time.sleep`` overshoots by up to this much, so the line busy-waits for the rest."""
ANSWER_S: Final = 5.0
"""How long the line's thread may take to plug or unplug."""


class Peer(Protocol):
    """The far end of a line. The line's thread makes all three calls."""

    def received(self, data: bytes, t: float) -> None:
        """Bytes from the client, read at `t` seconds (monotonic)."""
        ...

    def wake_in_s(self) -> float | None:
        """Seconds until `wake` should be called; None if only bytes matter."""
        ...

    def wake(self) -> None:
        """The requested time has come."""
        ...


class _Chunk(NamedTuple):
    due: float
    order: int
    data: bytes
    name: str
    device_id: int | None


class SerialLine(BusThread):
    """A serial port that a client opens by the name `link`, with `peer` behind it.

    Args:
        link: stable path for clients; it disappears while unplugged.
        peer: receives the client's bytes.
        name: of the bus, for the log and the thread.
        log: gets every chunk in and out.
        paced: charge ten bits a byte in both directions and keep return delays; else answer as fast as possible.
    """

    def __init__(
        self, link: Path, peer: Peer, *, name: str = "line", log: ByteLog | None = None, paced: bool = True
    ) -> None:
        super().__init__(name, ANSWER_S)
        self.link, self.paced = link, paced
        self._peer, self._log = peer, log or ByteLog(keep=False)
        self._outgoing: list[_Chunk] = []
        self._order = 0
        self._wire_free_at = 0.0
        self._baud: int | None = None
        self._terminal: Terminal | None = None

    # for the peer, in the line's thread

    @property
    def client_baud(self) -> int | None:
        """The baud rate of the bytes being received; None if the system cannot tell."""
        return self._baud

    def send(
        self, data: bytes, *, after_s: float = 0.0, late_s: float = 0.0, name: str = "", device_id: int | None = None
    ) -> None:
        """Queue bytes for the client; call it from the line's thread.

        Args:
            data: what to send.
            after_s: pause before them on the wire; later bytes wait for them. Ignored when not paced.
            late_s: hold only these bytes back this long beyond their time, paced or not.
            name: the instruction they answer, for the log.
            device_id: who sends, for the log.
        """
        due = time.monotonic()
        if self.paced:
            due = max(due, self._wire_free_at) + after_s + len(data) * self._byte_s()
            self._wire_free_at = due
        self._order += 1
        heapq.heappush(self._outgoing, _Chunk(due + late_s, self._order, data, name, device_id))

    # for any thread

    @property
    def plugged(self) -> bool:
        """Whether the adapter is plugged in."""
        return self._terminal is not None

    def unplug(self) -> None:
        """Pull the plug: clients get an input/output error, the link is gone, pending answers are lost."""
        self._ask(self._unplug)

    def replug(self) -> None:
        """Plug in again: a new pty behind the same link. Clients must open it again."""
        self._ask(self._replug)

    def nudge(self) -> None:
        """Query the peer's wake-up time again; call this when it has changed."""
        self._errands.ring()

    # the thread

    def _begin(self) -> None:
        self._terminal = Terminal(self.link)
        self._epoll = select.epoll()
        self._epoll.register(self._errands.wake_read, select.EPOLLIN)
        self._epoll.register(self._terminal.master, select.EPOLLIN)

    def _end(self) -> None:
        self._unplug("closed")
        self._epoll.close()

    def _step(self) -> None:
        for fd, _ in self._epoll.poll(self._patience_s()):
            if fd == self._errands.wake_read:
                self._errands.run()
            else:
                self._read()
        wake_in_s = self._peer.wake_in_s()
        if wake_in_s is not None and wake_in_s <= 0:
            self._peer.wake()
        self._write_due()

    def _patience_s(self) -> float:
        """How long to wait for bytes; epoll counts whole milliseconds and rounds up, which a due answer must not."""
        waits = [60.0]
        if (wake_in_s := self._peer.wake_in_s()) is not None:
            waits.append(max(0.0, wake_in_s))
        if self._outgoing:
            left_s = self._outgoing[0].due - time.monotonic() - SPIN_S
            waits.append(int(max(0.0, left_s) * 1e3) / 1e3)
        return min(waits)

    def _write_due(self) -> None:
        while (
            self._terminal is not None and self._outgoing and self._outgoing[0].due - time.monotonic() < SPIN_S + 0.001
        ):
            chunk = heapq.heappop(self._outgoing)
            # logged first: when a client has an answer, the log has it too, and the wire does not wait for the log
            due = max(chunk.due, time.monotonic())
            self._note("sent", chunk.data, due, name=chunk.name, device_id=chunk.device_id)
            _sleep_until(due)
            self._write(chunk)

    def _write(self, chunk: _Chunk) -> None:
        if self._terminal is None:
            return
        try:
            taken = os.write(self._terminal.master, chunk.data)
        except BlockingIOError:
            taken = 0
        if taken < len(chunk.data):
            detail = f"the client does not read: of the bytes just sent, the last {len(chunk.data) - taken} are lost"
            self._log.add(LogEntry(time.monotonic(), self.name, "event", "overrun", detail=detail))

    def _read(self) -> None:
        if self._terminal is None:
            return
        try:
            data = os.read(self._terminal.master, 65536)
        except BlockingIOError:
            return
        t = time.monotonic()
        self._baud = self._terminal.client_baud()
        if self.paced:
            self._wire_free_at = max(t, self._wire_free_at) + len(data) * self._byte_s()
        # events that were due before these bytes come first in the log
        self._peer.wake()
        self._note("received", data, t)
        self._peer.received(data, t)

    def _note(self, kind: Kind, data: bytes, t: float, *, name: str = "", device_id: int | None = None) -> None:
        self._log.add(LogEntry(t, self.name, kind, name, device_id=device_id, hex=data.hex()))

    def _byte_s(self) -> float:
        return BITS_PER_BYTE / self._baud if self._baud else 0.0

    def _unplug(self, event: str = "unplugged") -> None:
        terminal, self._terminal = self._terminal, None
        if terminal is None:
            return
        self._outgoing.clear()
        self._epoll.unregister(terminal.master)
        terminal.close()
        self._log.add(LogEntry(time.monotonic(), self.name, "event", event))

    def _replug(self) -> None:
        if self._terminal is not None:
            return
        self._terminal = Terminal(self.link)
        self._epoll.register(self._terminal.master, select.EPOLLIN)
        self._log.add(LogEntry(time.monotonic(), self.name, "event", "plugged"))


def _sleep_until(due: float) -> None:
    left_s = due - time.monotonic()
    if left_s > SPIN_S:
        time.sleep(left_s - SPIN_S)
    while time.monotonic() < due:
        pass
