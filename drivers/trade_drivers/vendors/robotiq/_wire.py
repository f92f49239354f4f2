"""The only module that uses pymodbus: its synchronous client on a port that sleeps while it waits.

The library polls, waits the full timeout after damaged answers, and takes late answers for those of the next request.
Overrides of its sending and receiving fix that; the encoding and decoding are the library's own.
"""

import errno
import logging
import time
from collections.abc import Callable, Sequence
from typing import Final

from pymodbus import ModbusException
from pymodbus.client import ModbusSerialClient
from pymodbus.framer import FramerRTU
from pymodbus.pdu import ModbusPDU

from trade_drivers.bus._jobs import Gate, NoAnswer, RequestRefused
from trade_drivers.bus._serial_port import DRAIN_S, LONGEST_WAIT_S, SerialLine, SerialWire
from trade_drivers.vendors.robotiq import _table as table

_READ_WRITE: Final = 23
_EXCEPTION: Final = 0x80
_OVERHEAD: Final = 5
"""Bytes of an answer in addition to its registers."""
_EXCEPTION_SIZE: Final = 5
_CLEAN_S: Final = 1.0
_LONGEST_DRAIN_S: Final = 0.120
"""The pause from the third consecutive failure."""
_OFTEN: Final = 2
_PROBES: Final = ((3, 1), (4, 1), (3, 2), (4, 2))
"""Functions and register counts, alternating so that a late answer does not match the next request."""

logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # it reports each timeout as an error; this driver counts them


class _QuietClient(ModbusSerialClient):
    """The library's client on our line; it sleeps until the answer arrives."""

    def __init__(self, line: SerialLine, path: str, baud: int) -> None:
        super().__init__(path, baudrate=baud, timeout=LONGEST_WAIT_S, retries=0)
        self._line = line
        self._head = b""
        self._size = 0

    def connect(self) -> bool:
        """Does nothing, as the owner opens and closes the line."""
        return self._line.is_open

    def expect(self, device_id: int, function: int, registers: int) -> None:
        """Sets the form of the next answer; anything else is ignored."""
        self._head = bytes((device_id, function, 2 * registers))
        self._size = _OVERHEAD + 2 * registers

    def send(self, request: bytes, addr: tuple[object, ...] | None = None) -> int:  # noqa: ARG002
        self._line.flush()
        sent = self._line.write(request)
        if sent < len(request):
            raise OSError(errno.EIO, "the request could not be written as a whole")
        self._line.expect(self._size)
        return sent

    def recv(self, size: int | None) -> bytes:  # noqa: ARG002
        """Returns the answer without other bytes; empty if it does not arrive in time."""
        while (frame := self._take()) is None:
            if not self._line.more():
                return b""
        return frame

    def _take(self) -> bytes | None:
        received = self._line.received
        refusal = bytes((self._head[0], self._head[1] | _EXCEPTION))
        for head, size in ((self._head, self._size), (refusal, _EXCEPTION_SIZE)):
            at = received.find(head)
            while at >= 0 and len(received) >= at + size:
                frame = bytes(received[at : at + size])
                if FramerRTU.compute_CRC(frame[:-2]) == int.from_bytes(frame[-2:], "big"):
                    return frame
                at = received.find(head, at + 1)
        return None


class Wire(SerialWire):
    """One serial port and the requests on it. All requests but stops may wait until the line is settled."""

    def __init__(self, path: str, baud: int, where: str = "bus") -> None:
        super().__init__(path, baud, where)
        self._client = _QuietClient(self._line, path, baud)
        self._in_a_row = 0
        self._failed_at = -_CLEAN_S
        self._failures = 0

    def read(self, device_id: int) -> list[int]:
        """Reads the status registers; for a second after a failure, with the other function for that."""
        self._settle()
        recently = time.monotonic() - self._failed_at < _CLEAN_S
        function = 3 if recently and self._failures % 2 else 4
        return self._ask(device_id, function, table.COUNT, lambda: self._reading(device_id, function, table.COUNT))

    def probe(self, device_id: int) -> None:
        """Sends a request whose answer differs from all late answers to earlier requests."""
        self._settle()
        function, count = _PROBES[self._failures % len(_PROBES)]
        self._ask(device_id, function, count, lambda: self._reading(device_id, function, count))

    def write(self, device_id: int, values: Sequence[int], gate: Gate | None = None, *, wait: bool = True) -> list[int]:
        """Writes the command registers and reads the status registers in one exchange (function 23).

        Args:
            device_id: of the gripper.
            values: of the three registers.
            gate: called immediately before the bytes are sent.
            wait: False for a stop, which does not pause after a failure.
        """
        if wait:
            self._settle()

        def ask() -> ModbusPDU:
            return self._client.readwrite_registers(
                read_address=table.STATUS,
                read_count=table.COUNT,
                write_address=table.COMMAND,
                values=list(values),
                device_id=device_id,
            )

        return self._ask(device_id, _READ_WRITE, table.COUNT, ask, gate)

    def _reading(self, device_id: int, function: int, count: int) -> ModbusPDU:
        reading = self._client.read_holding_registers if function == 3 else self._client.read_input_registers
        return reading(table.STATUS, count=count, device_id=device_id)

    def _ask(
        self, device_id: int, function: int, count: int, ask: Callable[[], ModbusPDU], gate: Gate | None = None
    ) -> list[int]:
        began = time.monotonic()
        self._client.expect(device_id, function, count)
        with self._use(gate):
            try:
                answer = ask()
            except ModbusException:
                self._failed()
                raise NoAnswer(device_id, time.monotonic() - began) from None
        if answer.isError():
            reason = f"id {device_id} answered with exception {answer.exception_code}, which a 2F-85 never does"
            raise RequestRefused(device_id, reason)
        self._in_a_row = 0
        return list(answer.registers)

    def _failed(self) -> None:
        self._unsettle(DRAIN_S if self._in_a_row < _OFTEN else _LONGEST_DRAIN_S)
        self._failed_at = time.monotonic()
        self._failures += 1
        self._in_a_row += 1
