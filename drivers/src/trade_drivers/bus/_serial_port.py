"""A serial port, as the drivers of all vendors use it: one process owns it, its thread sleeps until bytes come.

Only for modules that are imported with a vendor's library: pyserial comes with that.
"""

import errno
import os
import select
import termios
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from typing import Final

import serial

from trade.errors import ConfigurationError, TradeError
from trade_drivers.bus._jobs import TAKEN, Gate, PortLost

__all__ = ["ANSWER_MARGIN_S", "DRAIN_S", "LONGEST_WAIT_S", "SerialLine", "SerialWire"]

ANSWER_MARGIN_S: Final = 0.034
"""Patience beyond the time the bytes take: twice the default 16 ms latency of an FTDI adapter, and 2 ms."""
LONGEST_WAIT_S: Final = 0.048
"""No exchange waits longer than this, so that a stop is never more than 50 ms from the wire."""
DRAIN_S: Final = 0.030
"""Silence kept after a failed exchange: an answer that is late arrives now and is thrown away, not believed later."""

_BITS_PER_BYTE: Final = 10


class SerialLine:
    """The bytes of one port: what vendor libraries are given instead of a port of their own.

    All but ``close`` raises OSError or termios.error when the port is gone.
    """

    gate: Gate | None = None
    """Asked right before bytes go out."""

    def __init__(self, path: str, baud: int) -> None:
        self.received = bytearray()
        """What has come and was not taken yet."""
        self._path, self._baud = path, baud
        self._byte_s = _BITS_PER_BYTE / baud
        self._port: serial.Serial | None = None
        self._poll = select.poll()
        self._sent = 0
        self._deadline = 0.0

    @property
    def is_open(self) -> bool:
        """It can be used."""
        return self._port is not None

    def open(self) -> None:
        """Take the port for this process alone; raises ValueError, too."""
        self._port = serial.Serial(self._path, self._baud, timeout=0, write_timeout=0, exclusive=True)
        with suppress(ValueError, OSError, AttributeError):  # not every adapter has it
            self._port.set_low_latency_mode(True)  # pyright: ignore[reportUnknownMemberType]
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    @property
    def _fd(self) -> int:
        if self._port is None or self._port.fd is None:  # pyright: ignore[reportUnnecessaryComparison]
            raise OSError(errno.EBADF, "the port is not open")
        return int(self._port.fd)

    def close(self) -> None:
        """Let go of the port; more than once is fine."""
        port, self._port = self._port, None
        if port is not None:
            with suppress(OSError, termios.error):
                port.close()

    def flush(self) -> None:
        """Throw away what has come."""
        self.received.clear()
        termios.tcflush(self._fd, termios.TCIFLUSH)

    def write(self, data: bytes) -> int:
        """Bytes out, after the gate; how many went."""
        if self.gate is not None:
            self.gate()
        self._sent = os.write(self._fd, data)
        return self._sent

    def expect(self, size: int) -> None:
        """Begin to wait for an answer of that many bytes to what was just written."""
        on_the_wire = (self._sent + size) * self._byte_s
        self._deadline = time.monotonic() + min(on_the_wire + ANSWER_MARGIN_S, LONGEST_WAIT_S)

    def more(self, for_s: float | None = None) -> bool:
        """Sleep until more bytes have come; False if none do: in this time, or while the answer is waited for."""
        left_s = self._deadline - time.monotonic() if for_s is None else for_s
        if left_s <= 0 or not self._poll.poll(left_s * 1e3):
            return False
        data = os.read(self._fd, 4096)
        if not data:
            raise OSError(errno.EIO, "the port hung up")
        self.received += data
        return True


class SerialWire:
    """One serial port and the exchanges on it. Not thread safe: one thread owns it.

    After an exchange that failed, the next one first keeps silent until ``settled_at``. ``pause`` is how it waits; it
    is called before every exchange that may wait, so that whoever gives it can put in what must not.
    """

    def __init__(self, path: str, baud: int, where: str = "bus") -> None:
        self.path = path
        self._where = where
        """The table of the robot file that describes this bus, for messages; empty: there is none."""
        self.settled_at = 0.0
        self.pause: Callable[[float], None] = time.sleep
        self._line = SerialLine(path, baud)

    def open(self) -> None:
        """Take the port for this process alone.

        Raises:
            ConfigurationError: another driver owns it, it is no serial port, or its baud rate or permissions are wrong.
            PortLost: there is no such device.
        """
        try:
            self._line.open()
        except (OSError, termios.error, ValueError) as bad:
            self.close()
            raise self._cannot_open(bad) from None

    def _cannot_open(self, bad: Exception) -> Exception:
        match _error_number(bad):
            case errno.EAGAIN | errno.EBUSY:
                problem = f"{TAKEN}; stop it first (`fuser {self.path}` names the process)"
            case errno.EACCES | errno.EPERM:
                problem = "no permission to open it; add yourself to its group (often dialout) and log in again"
            case errno.ENOTTY | errno.EISDIR:
                problem = "is no serial port; `ls -l /dev/serial/by-id` shows those there are"
            case errno.ENOENT:
                return _lost("there is no such device")
            case _:
                return _lost(_text(bad))
        return self._wrong("port", problem)

    def _wrong(self, key: str, problem: str) -> ConfigurationError:
        if not self._where:
            return ConfigurationError(where=self.path, problem=problem)
        said = f"{self.path}: {problem}" if key == "port" else problem
        return ConfigurationError(where=f"{self._where}.{key}", problem=said)

    def close(self) -> None:
        """Let go of the port; more than once is fine."""
        self._line.close()

    @contextmanager
    def _use(self, gate: Gate | None = None) -> Generator[None, None, None]:
        """Use the port; the gate is asked right before bytes go out. Raises ``PortLost``."""
        if not self._line.is_open:
            raise PortLost("it is not open")
        self._line.gate = gate
        try:
            yield
        except TradeError:  # the gate's: some of them are OSErrors, too
            raise
        except (OSError, termios.error) as gone:
            raise _lost(_text(gone)) from None
        finally:
            self._line.gate = None

    def _settle(self) -> None:
        self.pause(max(0.0, self.settled_at - time.monotonic()))

    def _unsettle(self, drain_s: float = DRAIN_S) -> None:
        self.settled_at = time.monotonic() + drain_s


def _lost(why: str) -> PortLost:
    return PortLost(f"{why}; plug its adapter in again")


def _text(bad: Exception) -> str:
    number = _error_number(bad)
    return os.strerror(number) if number else str(bad)


def _error_number(bad: BaseException | None) -> int | None:
    """The system's number of an error, which pyserial often leaves in the error that its own stands for."""
    if bad is None:
        return None
    numbers: tuple[object, ...] = (getattr(bad, "errno", None), *bad.args[:1])
    return next((number for number in numbers if isinstance(number, int)), None) or _error_number(bad.__context__)
