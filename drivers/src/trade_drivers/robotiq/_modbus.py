"""The only place that touches pymodbus: its synchronous client on a port that sleeps while it waits.

The library polls, waits the full time for what came damaged, and takes a late answer for that of the next question.
Mended by overriding how it sends and receives; what it sends, and what it makes of an answer, is its own.
"""

import errno
import logging
import os
import select
import termios
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from typing import Final

import serial
from pymodbus import ModbusException
from pymodbus.client import ModbusSerialClient
from pymodbus.framer import FramerRTU
from pymodbus.pdu import ModbusPDU

from trade.errors import ConfigurationError, TradeError
from trade_drivers._work import Gate, PortLost
from trade_drivers.robotiq import _table as table
from trade_drivers.robotiq._wire import (
    ANSWER_MARGIN_S,
    DRAIN_S,
    LONGEST_DRAIN_S,
    LONGEST_WAIT_S,
    NoAnswer,
    Refused,
)

__all__ = ["Wire"]

_BITS_PER_BYTE: Final = 10
_READ_WRITE: Final = 23
_EXCEPTION: Final = 0x80
_OVERHEAD: Final = 5
"""Bytes of an answer beyond its registers."""
_EXCEPTION_SIZE: Final = 5
_CLEAN_S: Final = 1.0
_OFTEN: Final = 2
_PROBES: Final = ((3, 1), (4, 1), (3, 2), (4, 2))
"""Function and number of registers: a late answer to one of them is no answer to the next."""

logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # it reports every time-out as an error; ours are counted


class _QuietClient(ModbusSerialClient):
    """The library's client, on a port owned exclusively; it sleeps until the answer to its question has come."""

    gate: Gate | None = None

    def __init__(self, path: str, baud: int) -> None:
        super().__init__(path, baudrate=baud, timeout=LONGEST_WAIT_S, retries=0)
        self._path, self._baud = path, baud
        self._byte_s = _BITS_PER_BYTE / baud
        self._received = bytearray()
        self._poll = select.poll()
        self._deadline = 0.0
        self._head = b""
        self._size = 0

    def plug(self) -> None:
        """Open the port; raises what pyserial and the system raise."""
        self.socket = serial.Serial(self._path, self._baud, timeout=0, write_timeout=0, exclusive=True)
        with suppress(ValueError, OSError, AttributeError):  # not every adapter has it
            self.socket.set_low_latency_mode(True)  # pyright: ignore[reportUnknownMemberType]
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    @property
    def _fd(self) -> int:
        if self.socket is None or self.socket.fd is None:  # pyright: ignore[reportUnnecessaryComparison]
            raise OSError(errno.EBADF, "the port is not open")
        return int(self.socket.fd)

    def expect(self, device_id: int, function: int, registers: int) -> None:
        """What the answer to the next request looks like; anything else that comes is not it."""
        self._head = bytes((device_id, function, 2 * registers))
        self._size = _OVERHEAD + 2 * registers

    def send(self, request: bytes, addr: tuple[object, ...] | None = None) -> int:  # noqa: ARG002
        self._received.clear()
        termios.tcflush(self._fd, termios.TCIFLUSH)
        if self.gate is not None:
            self.gate()
        on_the_wire = (len(request) + self._size) * self._byte_s
        sent = os.write(self._fd, request)
        self._deadline = time.monotonic() + min(on_the_wire + ANSWER_MARGIN_S, LONGEST_WAIT_S)
        if sent < len(request):
            raise OSError(errno.EIO, "the request could not be written as a whole")
        return sent

    def recv(self, size: int | None) -> bytes:  # noqa: ARG002
        """The answer, freed of all that is not it; empty if it does not come in time."""
        while (frame := self._take()) is None:
            left_s = self._deadline - time.monotonic()
            if left_s <= 0 or not self._poll.poll(left_s * 1e3):
                return b""
            data = os.read(self._fd, 4096)
            if not data:
                raise OSError(errno.EIO, "the port hung up")
            self._received += data
        return frame

    def _take(self) -> bytes | None:
        refusal = bytes((self._head[0], self._head[1] | _EXCEPTION))
        for head, size in ((self._head, self._size), (refusal, _EXCEPTION_SIZE)):
            at = self._received.find(head)
            while at >= 0 and len(self._received) >= at + size:
                frame = bytes(self._received[at : at + size])
                if FramerRTU.compute_CRC(frame[:-2]) == int.from_bytes(frame[-2:], "big"):
                    return frame
                at = self._received.find(head, at + 1)
        return None


class Wire:
    """One serial port and the requests on it. Not thread safe: one thread owns it.

    After an exchange that failed, the next one first keeps silent until ``settled_at``. ``pause`` is how it waits; it
    is called before every exchange but a stop, so that whoever gives it can put in what must not wait.
    """

    def __init__(self, path: str, baud: int, where: str = "bus") -> None:
        self.path = path
        self._where = where
        """The table of the robot file that describes this bus, for messages."""
        self.settled_at = 0.0
        self.pause: Callable[[float], None] = time.sleep
        self._client = _QuietClient(path, baud)
        self._in_a_row = 0
        self._failed_at = -_CLEAN_S
        self._failures = 0

    def open(self) -> None:
        """Take the port for this process alone.

        Raises:
            ConfigurationError: another driver owns it, it is no serial port, or its baud rate or permissions are wrong.
            PortLost: there is no such device.
        """
        try:
            self._client.plug()
        except (OSError, termios.error, ValueError) as bad:
            self.close()
            raise self._cannot_open(bad) from None

    def _cannot_open(self, bad: Exception) -> Exception:
        match _error_number(bad):
            case errno.EAGAIN | errno.EBUSY:
                problem = f"another driver owns this port; stop it first (`fuser {self.path}` names the process)"
            case errno.EACCES | errno.EPERM:
                problem = "no permission to open it; add yourself to its group (often dialout) and log in again"
            case errno.ENOTTY | errno.EISDIR:
                problem = "is no serial port; `ls -l /dev/serial/by-id` shows those there are"
            case errno.ENOENT:
                return PortLost("there is no such device")
            case _:
                return PortLost(str(bad))
        return ConfigurationError(where=f"{self._where}.port", problem=f"{self.path}: {problem}")

    def close(self) -> None:
        """Let go of the port; more than once is fine."""
        with suppress(OSError, termios.error):
            self._client.close()
        self._client.socket = None

    def read(self, device_id: int) -> list[int]:
        """The status registers. For a second after a failure, by the other function that reads them."""
        self._settle()
        recently = time.monotonic() - self._failed_at < _CLEAN_S
        function = 3 if recently and self._failures % 2 else 4
        return self._ask(device_id, function, table.COUNT, lambda: self._reading(device_id, function, table.COUNT))

    def probe(self, device_id: int) -> None:
        """Hear from a device in a way that no late answer to an earlier question can be taken for."""
        self._settle()
        function, count = _PROBES[self._failures % len(_PROBES)]
        self._ask(device_id, function, count, lambda: self._reading(device_id, function, count))

    def write(self, device_id: int, values: Sequence[int], gate: Gate | None = None, *, wait: bool = True) -> list[int]:
        """Write the command registers and read the status registers, in one exchange (function 23).

        Args:
            device_id: whose.
            values: three registers.
            gate: asked right before the bytes go out.
            wait: False for a stop: it does not keep silent after a failure.
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
        with self._lost(), self._gated(gate):
            try:
                answer = ask()
            except ModbusException:
                self._unsettle()
                raise NoAnswer(device_id, time.monotonic() - began) from None
        if answer.isError():
            raise Refused(device_id, answer.exception_code)
        self._in_a_row = 0
        return list(answer.registers)

    @contextmanager
    def _gated(self, gate: Gate | None) -> Generator[None, None, None]:
        self._client.gate = gate
        try:
            yield
        finally:
            self._client.gate = None

    @contextmanager
    def _lost(self) -> Generator[None, None, None]:
        if self._client.socket is None:
            raise PortLost("it is not open")
        try:
            yield
        except TradeError:  # a gate's: some of them are OSErrors, too
            raise
        except (OSError, termios.error) as gone:
            raise PortLost(str(gone)) from None

    def _settle(self) -> None:
        self.pause(max(0.0, self.settled_at - time.monotonic()))

    def _unsettle(self) -> None:
        self._failed_at = time.monotonic()
        self._failures += 1
        self.settled_at = self._failed_at + (DRAIN_S if self._in_a_row < _OFTEN else LONGEST_DRAIN_S)
        self._in_a_row += 1


def _error_number(bad: BaseException | None) -> int | None:
    """The system's number of an error, which pyserial often leaves in the error that its own stands for."""
    if bad is None:
        return None
    numbers: Iterable[object] = (getattr(bad, "errno", None), *bad.args[:1])
    return next((number for number in numbers if isinstance(number, int)), None) or _error_number(bad.__context__)
