"""The only place that touches dynamixel-sdk: its protocol handler on a port that sleeps while it waits.

The vendor library is untyped, polls with a full core, trusts the wall clock, stays "busy" for ever once a call raised,
and does not look at the length of an answer. All this is mended here by overriding; what it sends is its own.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUntypedBaseClass=false, reportUnknownParameterType=false, reportIncompatibleMethodOverride=false

import errno
import os
import select
import termios
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

import serial
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, COMM_SUCCESS, PortHandler, Protocol2PacketHandler

from trade.errors import ConfigurationError, TradeError
from trade_drivers.dynamixel._frames import HEADER, OVERHEAD, Corrupt, crc16, take_status, unstuffed
from trade_drivers.dynamixel._wire import (
    ANSWER_MARGIN_S,
    DRAIN_S,
    LONGEST_WAIT_S,
    Answer,
    BadAnswer,
    NoAnswer,
    Refused,
)
from trade_drivers.joints import Gate, PortLost

__all__ = ["Wire"]

_BROADCAST: Final = 254
_ALERT: Final = 0x80
_WHOLE_SECOND_ANSWER_S: Final = 0.005
_BAUDS: Final = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
"""XL430 e-Manual, register 8, without 4.5 Mbaud, which the library does not know."""


class _QuietPort(PortHandler):
    """The SDK's port, owned exclusively, that sleeps until bytes arrive and counts time by the monotonic clock."""

    gate: Gate | None = None
    expected: int | None = None
    """Bytes of parameters the answer must have; another length is the late answer of an earlier question."""

    def __init__(self, path: str, baud: int) -> None:
        super().__init__(path)
        self.baudrate = baud
        self._received = bytearray()
        self._sent = 0
        self._byte_s = 10 / baud
        self._deadline = 0.0
        self._poll = select.poll()

    def setupPort(self, cflag_baud: int) -> bool:  # noqa: ARG002, N802
        self.ser: Any = serial.Serial(self.port_name, self.baudrate, timeout=0, write_timeout=0, exclusive=True)
        with suppress(ValueError, OSError, AttributeError):  # not every adapter has it
            self.ser.set_low_latency_mode(True)
        self.is_open = True
        self._poll = select.poll()
        self._poll.register(self.ser.fd, select.POLLIN)
        self.clearPort()
        return True

    def clearPort(self) -> None:  # noqa: N802
        self._received.clear()
        termios.tcflush(self.ser.fd, termios.TCIFLUSH)

    def writePort(self, packet: Sequence[int]) -> int:  # noqa: N802
        data = bytes(packet)
        if self.gate is not None:
            self.gate()
        self._sent = os.write(self.ser.fd, data)
        return self._sent

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        on_the_wire = (self._sent + packet_length) * self._byte_s
        self._deadline = time.monotonic() + min(on_the_wire + ANSWER_MARGIN_S, LONGEST_WAIT_S)

    def wait(self, deadline: float) -> bool:
        """More bytes by then, or False; a port that hung up raises OSError."""
        left = deadline - time.monotonic()
        if left <= 0 or not self._poll.poll(left * 1e3):
            return False
        data = os.read(self.ser.fd, 4096)
        if not data:
            raise OSError(errno.EIO, "the port hung up")
        self._received += data
        return True

    def frame(self) -> bytes | None:
        """The next status packet of the expected length, or None if none came in time; Corrupt if it is damaged."""
        while True:
            frame = take_status(self._received)
            if frame is None:
                if self.wait(self._deadline):
                    continue
                if self._received:
                    raise Corrupt
                return None
            frame = frame if frame[4] == _BROADCAST else unstuffed(frame)
            if self.expected is None or len(frame) == OVERHEAD + self.expected or frame[8] & ~_ALERT:
                return frame

    def more(self, for_s: float) -> bool:
        """Anything else that arrives within this time."""
        return bool(self._received) or self.wait(time.monotonic() + for_s)


class _Packets(Protocol2PacketHandler):
    """The SDK's protocol 2.0, parsing a packet in one go and never sending one with a header in its parameters."""

    def updateCRC(self, crc_accum: int, data_blk_ptr: Sequence[int], data_blk_size: int) -> int:  # noqa: N802
        return crc16(data_blk_ptr[:data_blk_size], crc_accum)

    def addStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        # The SDK throws the stuffed packet away and sends the bare one, which a servo misreads from its middle.
        if HEADER in bytes(packet[7:-2]):
            raise ValueError(
                "the parameters contain FF FF FD, which the vendor library sends wrongly; nothing was sent"
            )
        return packet

    def rxPacket(self, port: _QuietPort, fast_option: bool) -> tuple[Sequence[int], int]:  # noqa: ARG002, N802
        try:
            frame = port.frame()
        except Corrupt:
            return b"", COMM_RX_CORRUPT
        finally:
            port.is_using = False
        return (b"", COMM_RX_TIMEOUT) if frame is None else (frame, COMM_SUCCESS)


def _error_number(bad: BaseException | None) -> int | None:
    """The system's number of an error, which pyserial often leaves in the error that its own stands for."""
    if bad is None:
        return None
    numbers = [getattr(bad, "errno", None), *bad.args[:1]]
    return next((number for number in numbers if isinstance(number, int)), None) or _error_number(bad.__context__)


class Wire:
    """One serial port and the packets on it. Not thread safe: one thread owns it.

    After an exchange that failed, the next one first keeps silent until ``settled_at``. ``pause`` is how it waits; it
    is called before every exchange, so that whoever gives it can put in what must not wait.
    """

    def __init__(self, path: str, baud: int, where: str = "bus") -> None:
        self.path = path
        self._where = where
        """The table of the robot file that describes this bus, for messages."""
        self.settled_at = 0.0
        self.pause: Callable[[float], None] = time.sleep
        self._port = _QuietPort(path, baud)
        self._packets = _Packets()

    def open(self) -> None:
        """Take the port for this process alone.

        Raises:
            ConfigurationError: another driver owns it, it is no serial port, or its baud rate or permissions are wrong.
            PortLost: there is no such device.
        """
        try:
            opened = self._port.openPort()
        except (OSError, termios.error) as bad:
            self.close()
            raise self._cannot_open(bad) from None
        if not opened:
            problem = f"{self._port.baudrate} cannot be set; the servos know {', '.join(map(str, _BAUDS))}"
            raise ConfigurationError(where=f"{self._where}.baud", problem=problem)

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
        self._port.is_using = False
        if self._port.ser is not None:
            with suppress(OSError, termios.error):
                self._port.closePort()

    def ping(self, device_id: int) -> int:
        """The model number of a device."""
        with self._exchange(device_id, expected=3):
            model, result, _ = self._packets.ping(self._port, device_id)
            self._require(result, device_id)
        return int(model)

    def answers_twice(self) -> bool:
        """Whether anything follows the answer just received, as it does when two devices share an id."""
        with self._lost():
            return self._port.more(_WHOLE_SECOND_ANSWER_S)

    def read(self, device_id: int, address: int, size: int) -> Answer:
        """Bytes of one device's control table."""
        with self._exchange(device_id, expected=size):
            data, result, error = self._packets.readTxRx(self._port, device_id, address, size)
            self._require(result, device_id, error)
        return Answer(bytes(data), bool(error & _ALERT))

    def write(self, device_id: int, address: int, data: bytes, gate: Gate | None = None) -> None:
        """Change one device's control table, and hear that it did."""
        with self._exchange(device_id, expected=0, gate=gate):
            result, error = self._packets.writeTxRx(self._port, device_id, address, len(data), data)
            self._require(result, device_id, error)

    def sync_write(self, address: int, data: Mapping[int, bytes], gate: Gate | None = None) -> None:
        """The same registers of several devices, in one packet that nobody answers. Never waits, not even to settle."""
        size = len(next(iter(data.values())))
        parameters = [byte for device_id, value in data.items() for byte in (device_id, *value)]
        with self._lost(), self._gated(gate):
            result = self._packets.syncWriteTxOnly(self._port, address, size, parameters, len(parameters))
        if result != COMM_SUCCESS:
            raise PortLost("the packet could not be written as a whole")

    def sync_read(self, address: int, size: int, ids: Sequence[int], *, fast: bool = False) -> dict[int, Answer]:
        """The same registers of several devices; those that did not answer properly are left out."""
        self._settle()
        with self._lost():
            self._port.expected = len(ids) * (size + 4) - 3 if fast else size
            result = self._packets.syncReadTx(self._port, address, size, ids, len(ids), fast)
            if result != COMM_SUCCESS:
                raise PortLost("the packet could not be written as a whole")
            found = self._joined(size, len(ids)) if fast else self._single(len(ids))
            answers = {device_id: answer for device_id, answer in found if device_id in ids}
        if len(answers) < len(ids):
            self._unsettle()
        return answers

    def _single(self, count: int) -> Iterator[tuple[int, Answer]]:
        for _ in range(count):
            try:
                frame = self._port.frame()
            except Corrupt:
                continue
            if frame is None:
                return
            yield frame[4], Answer(frame[9:-2], bool(frame[8] & _ALERT))

    def _joined(self, size: int, count: int) -> Iterable[tuple[int, Answer]]:
        try:
            frame = self._port.frame()
        except Corrupt:
            return ()
        if frame is None:
            return ()
        starts = range(8, 8 + count * (size + 4), size + 4)
        return [(frame[at + 1], Answer(frame[at + 2 : at + 2 + size], bool(frame[at] & _ALERT))) for at in starts]

    @contextmanager
    def _exchange(self, device_id: int, *, expected: int, gate: Gate | None = None) -> Generator[None, None, None]:
        self._settle()
        self._port.expected = expected
        began = time.monotonic()
        with self._lost(), self._gated(gate):
            try:
                yield
            except NoAnswer as silent:
                self._unsettle()
                raise type(silent)(device_id, time.monotonic() - began) from None

    @contextmanager
    def _gated(self, gate: Gate | None) -> Generator[None, None, None]:
        self._port.gate = gate
        try:
            yield
        finally:
            self._port.gate = None

    @contextmanager
    def _lost(self) -> Generator[None, None, None]:
        if not self._port.is_open:
            raise PortLost("it is not open")
        try:
            yield
        except TradeError:  # a gate's: some of them are OSErrors, too
            raise
        except (OSError, termios.error) as gone:
            raise PortLost(str(gone)) from None
        finally:
            self._port.is_using = False

    def _settle(self) -> None:
        self.pause(max(0.0, self.settled_at - time.monotonic()))

    def _unsettle(self) -> None:
        self.settled_at = time.monotonic() + DRAIN_S

    def _require(self, result: int, device_id: int, error: int = 0) -> None:
        match result:
            case 0:
                if number := error & ~_ALERT:
                    raise Refused(device_id, number)
            case -3001:
                raise NoAnswer(device_id, 0.0)
            case -3002:
                raise BadAnswer(device_id, 0.0)
            case _:
                raise PortLost(f"the library returned {result}")
