"""canopen's network, fed and driven by the bus thread: none of the library's own threads, and no state it caches."""

import struct
import time
from collections.abc import Callable
from queue import Queue
from typing import Any, Final

from canopen import Network, ObjectDictionary
from canopen.emcy import EmcyError
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from trade_drivers.can import CanPort
from trade_drivers.cia402 import _table as table
from trade_drivers.cia402._table import Entry
from trade_drivers.joints import Gate

__all__ = ["Net", "NoAnswer", "Refused", "emergency_text"]

ATTEMPTS: Final = 3
_ANSWER_S: Final = 0.040
"""Patience for one answer, so that a stop is never more than 50 ms from the wire."""
_DRAIN_S: Final = 0.030
"""After a failed exchange: an answer that is late arrives now and is thrown away, not believed later."""
_SDO_SIZE: Final = 8
_SLICE_S: Final = 0.004
"""Longest wait for a frame before stops are looked for."""


class NoAnswer(Exception):
    """A drive did not answer a request in time, or not to that one."""


class Refused(Exception):
    """A drive answered that it would not."""

    def __init__(self, entry: object, code: int, text: str) -> None:
        super().__init__(f"{entry}: {text}")
        self.code = code


def emergency_text(code: int) -> str:
    """What an error code of a drive means, in short."""
    known = _CODES.get(code) or EmcyError(code, 0, b"", 0.0).get_desc()
    return f"error {code:04X}h" + (f", {known.lower()}" if known else "")


_CODES: Final = {
    0x2310: "continuous over-current",
    0x3210: "over-voltage",
    0x3220: "under-voltage",
    0x4210: "over-temperature of the device",
    0x4310: "over-temperature of the drive",
    0x7305: "encoder",
    0x8120: "its CAN controller is error passive",
    0x8130: "it has not heard this driver for too long",
    0x8140: "it has come back from bus-off",
    0x8210: "a PDO was too short",
    0x8611: "following error",
}


class _Client(SdoClient):
    """The library's SDO client, but who waits takes the frames in itself."""

    RESPONSE_TIMEOUT = 0
    """What is there when the wait is over is there."""
    responses: "Queue[bytes]"

    def __init__(self, node: int, net: "Net") -> None:
        super().__init__(table.SDO_REQUEST + node, table.SDO_ANSWER + node, ObjectDictionary())
        self.network = self._net = net
        net.hear(table.SDO_ANSWER + node, self._keep)

    def _keep(self, data: bytes) -> None:
        if len(data) == _SDO_SIZE:
            self.responses.put(data)

    def read_response(self) -> bytes:
        self._net.take_in(_ANSWER_S, lambda: not self.responses.empty())
        return super().read_response()  # pyright: ignore[reportUnknownVariableType]

    def abort(self, abort_code: int = 0x08000000) -> None:
        self._net.port.send(self.rx_cobid, struct.pack("<BHBI", 0x80, 0, 0, abort_code))


class Net(Network):
    """One CAN bus with its nodes. Everything belongs to the thread that owns the port."""

    def __init__(self, port: CanPort, between: Callable[[], None]) -> None:
        super().__init__()
        self.port = port
        self.between = between
        """Called between frames: it may send, but not wait."""
        self._clients: dict[int, _Client] = {}

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        """One frame out, for the library."""
        self.port.send(can_id, bytes(data))

    def hear(self, can_id: int, listener: Callable[[bytes], None]) -> None:
        """Have frames of an identifier given to a listener."""

        def hand_on(_: int, data: Any, __: float) -> None:
            listener(bytes(data))

        self.subscribe(can_id, hand_on)

    def take_in(self, seconds: float, enough: Callable[[], bool] = lambda: False) -> None:
        """Take frames in for that long, or until it is enough; 0 takes in what has come already.

        Raises:
            PortLost: the bus is gone.
        """
        until = time.monotonic() + seconds
        while True:
            self.between()
            if enough():
                return
            left_s = until - time.monotonic()
            frame = self.port.receive(max(0.0, min(left_s, _SLICE_S)))
            if frame is not None:
                self.notify(frame.id, bytearray(frame.data), time.time())
            elif left_s <= 0:
                return

    def command(self, node: int, word: int) -> None:
        """Network management: start a node, and so on. Nobody confirms it."""
        self.port.send(table.NMT, bytes((word, node)))

    def read(self, node: int, entry: Entry, attempts: int = ATTEMPTS) -> int:
        """A number out of a drive's dictionary.

        Raises:
            NoAnswer, Refused: what became of it.
        """
        data = self._transfer(node, entry, lambda client: client.upload(entry.index, entry.sub), attempts)
        if len(data) < entry.size:
            raise NoAnswer(f"{entry} came with {len(data)} bytes")
        return entry.decode(data)

    def read_text(self, node: int, index: int) -> str:
        """A text out of a drive's dictionary."""
        data = self._transfer(node, f"{index:04X}h", lambda client: client.upload(index, 0), ATTEMPTS)
        return data.rstrip(b"\0 ").decode("ascii", "replace")

    def write(self, node: int, entry: Entry, value: int, gate: Gate | None = None, attempts: int = ATTEMPTS) -> None:
        """A number into a drive's dictionary; the gate is asked right before each attempt."""

        def download(client: _Client) -> bytes:
            if gate is not None:
                gate()
            client.download(entry.index, entry.sub, entry.encode(value))
            return b""

        self._transfer(node, entry, download, attempts)

    def _transfer(self, node: int, entry: object, act: Callable[[_Client], bytes], attempts: int) -> bytes:
        client = self._clients.get(node) or self._clients.setdefault(node, _Client(node, self))
        problem: Exception | None = None
        for _ in range(attempts):
            try:
                return bytes(act(client))
            except SdoAbortedError as refused:
                raise Refused(entry, refused.code, str(refused)) from None
            except (SdoCommunicationError, struct.error) as silent:
                problem = silent
                self.take_in(_DRAIN_S)
        raise NoAnswer(f"{entry}: {problem}")
