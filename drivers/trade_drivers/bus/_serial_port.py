"""A serial port for drivers of all vendors: one process owns it, and its thread sleeps until bytes arrive.

Only modules that need a vendor's library may import this one, as it needs pyserial.
"""

import errno
import logging
import os
import select
import termios
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from typing import Final

import serial

from trade.errors import ConfigurationError, TradeError
from trade_drivers.bus._holders import holders
from trade_drivers.bus._jobs import SHARED, TAKEN, Gate, PortLost

ANSWER_MARGIN_S: Final = 0.034
"""Timeout beyond the transmission time: twice the default 16 ms latency of an FTDI adapter, and 2 ms."""
LONGEST_WAIT_S: Final = 0.048
"""The longest wait of an exchange, so that a stop is sent within 50 ms."""
DRAIN_S: Final = 0.030
"""The pause after a failed exchange, in which late answers arrive and are discarded."""

_log = logging.getLogger("trade")
_BITS_PER_BYTE: Final = 10
_SOUGHT_S: Final = 5.0
"""How long bytes that another program took explain missing answers, and how often that program is searched."""


class SerialLine:
    """The byte stream of one port, which vendor libraries use instead of a port of their own.

    All methods but ``close`` raise OSError or termios.error when the port is gone.
    """

    gate: Gate | None = None
    """Called immediately before bytes are sent."""

    def __init__(self, path: str, baud: int) -> None:
        self.received = bytearray()
        """Received bytes that have not been read yet."""
        self._path, self._baud = path, baud
        self._byte_s = _BITS_PER_BYTE / baud
        self._port: serial.Serial | None = None
        self._poll = select.poll()
        self._sent = 0
        self._deadline = 0.0
        self.stolen_at = -_SOUGHT_S
        """When another program last read bytes that were on their way to this one."""
        self._overdue = False
        """Whether the timeout of the answer is over and all that arrived until then was read."""

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def open(self) -> None:
        """Opens the port for exclusive use; may also raise ValueError."""
        self._port = serial.Serial(self._path, self._baud, timeout=0, write_timeout=0, exclusive=True)
        with suppress(ValueError, OSError, AttributeError):  # not all adapters support it
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
        """Discards received bytes."""
        self.received.clear()
        termios.tcflush(self._fd, termios.TCIFLUSH)

    def write(self, data: bytes) -> int:
        """Sends bytes after the gate; returns how many were sent."""
        if self.gate is not None:
            self.gate()
        self._sent = os.write(self._fd, data)
        return self._sent

    def expect(self, size: int) -> None:
        """Starts the timeout for an answer of this size to the last request."""
        on_the_wire = (self._sent + size) * self._byte_s
        self._deadline = time.monotonic() + min(on_the_wire + ANSWER_MARGIN_S, LONGEST_WAIT_S)
        self._overdue = False

    def more(self, for_s: float | None = None) -> bool:
        """Waits for more bytes; returns False if none arrive in this time or before the answer's timeout.

        Bytes that arrived while this thread was held up past the timeout are read once: the device was not late.
        """
        if for_s is None:
            for_s = self._deadline - time.monotonic()
            if for_s <= 0:
                if self._overdue:
                    return False
                for_s, self._overdue = 0, True
        until = time.monotonic() + for_s
        while for_s >= 0 and (ready := self._poll.poll(for_s * 1e3)):
            if data := self._read():
                self.received += data
                return True
            if ready[0][1] != select.POLLIN:
                raise OSError(errno.EIO, "the port hung up")
            self.stolen_at = time.monotonic()
            for_s = until - self.stolen_at
        self._overdue = True
        return False

    def _read(self) -> bytes:
        try:
            return os.read(self._fd, 4096)
        except BlockingIOError:
            return b""


class SerialWire:
    """One serial port and the exchanges on it. Not thread-safe: one thread owns it.

    After a failed exchange, the next one first waits until ``settled_at``. It waits by a call of ``pause``, which comes
    before each exchange that may wait and can run urgent work, such as stops.
    """

    def __init__(self, path: str, baud: int, where: str = "bus") -> None:
        self.path = path
        self._where = where
        """The bus's table in the robot file, for messages; empty if it has none."""
        self.settled_at = 0.0
        self.pause: Callable[[float], None] = time.sleep
        self._line = SerialLine(path, baud)
        self._others, self._sought_at = "", -_SOUGHT_S

    def open(self) -> None:
        """Opens the port for exclusive use.

        Raises:
            ConfigurationError: another program has it, it is not a serial port, or baud rate or permissions are wrong.
            PortLost: there is no such device.
        """
        try:
            self._line.open()
        except (OSError, termios.error, ValueError) as bad:
            self.close()
            raise self._cannot_open(bad) from None
        if others := ", ".join(holders(self.path)):
            self.close()
            raise self._wrong("port", f"{SHARED}, and would take answers away: {others}; end it first")

    def intruder(self) -> str:
        """Returns who else reads this port and may have taken missing answers away; empty if nothing says so.

        It never waits: another thread searches the host's processes.
        """
        now = time.monotonic()
        if now - self._sought_at > _SOUGHT_S:
            self._sought_at = now
            threading.Thread(target=self._seek, name=f"who reads {self.path}", daemon=True).start()
        if not self._others and now - self._line.stolen_at > _SOUGHT_S:
            return ""
        who = self._others or f"`sudo fuser {self.path}` names it"
        return f"{SHARED}, and takes answers away: {who}; end it"

    def _seek(self) -> None:
        if others := ", ".join(holders(self.path)):
            _log.warning("%s: %s, and takes answers away: %s", self.path, SHARED, others)
        self._others = others

    def _cannot_open(self, bad: Exception) -> Exception:
        match _error_number(bad):
            case errno.EAGAIN | errno.EBUSY:
                who = ", ".join(holders(self.path)) or f"`sudo fuser {self.path}` names the process"
                problem = f"{TAKEN}; stop it first ({who})"
            case errno.EACCES | errno.EPERM:
                problem = "no permission to open it; add yourself to its group (often dialout) and log in again"
            case errno.ENOTTY | errno.EISDIR:
                problem = "is not a serial port; `ls -l /dev/serial/by-id` lists the ports"
            case errno.ENOENT:
                return _lost("there is no such device")
            case _:
                return _lost(_text(bad))
        return self._wrong("port", problem)

    def _wrong(self, key: str, problem: str) -> ConfigurationError:
        if not self._where:
            return ConfigurationError(where=self.path, problem=problem)
        text = f"{self.path}: {problem}" if key == "port" else problem
        return ConfigurationError(where=f"{self._where}.{key}", problem=text)

    def close(self) -> None:
        """Let go of the port; more than once is fine."""
        self._line.close()

    @contextmanager
    def _use(self, gate: Gate | None = None) -> Generator[None, None, None]:
        """Uses the port, with a gate for sent bytes. Raises ``PortLost``."""
        if not self._line.is_open:
            raise PortLost("it is not open")
        self._line.gate = gate
        try:
            yield
        except TradeError:  # from the gate; some of them are OSErrors, too
            raise
        except (OSError, termios.error) as gone:
            raise _lost(_text(gone)) from None
        finally:
            self._line.gate = None

    def _settle(self) -> None:
        self.pause(max(0.0, self.settled_at - time.monotonic()))

    def _unsettle(self, drain_s: float = DRAIN_S) -> None:
        self.settled_at = time.monotonic() + drain_s


def _lost(reason: str) -> PortLost:
    return PortLost(f"{reason}; plug its adapter in again")


def _text(bad: Exception) -> str:
    number = _error_number(bad)
    return os.strerror(number) if number else str(bad)


def _error_number(bad: BaseException | None) -> int | None:
    """Returns the errno of an error, which pyserial often leaves in the original exception."""
    if bad is None:
        return None
    numbers: tuple[object, ...] = (getattr(bad, "errno", None), *bad.args[:1])
    return next((number for number in numbers if isinstance(number, int)), None) or _error_number(bad.__context__)
