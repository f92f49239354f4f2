"""The only module that uses dynamixel-sdk: its protocol handler on a port that sleeps while it waits.

The vendor library is untyped, polls with a full core, uses the wall clock, stays "busy" after a call has raised,
and does not check the length of an answer. Overrides fix all this here; the bytes sent are the library's own.

Status packets are decoded here, by functions without I/O and without a clock. Source: ROBOTIS e-Manual, "DYNAMIXEL
Protocol 2.0": ``FF FF FD 00 | ID | LEN16 | 55 | ERR | parameters | CRC16``.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUntypedBaseClass=false, reportUnknownParameterType=false, reportIncompatibleMethodOverride=false

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, COMM_SUCCESS, PortHandler, Protocol2PacketHandler

from trade_drivers.bus._serial_port import SerialLine
from trade_drivers.joints import Gate, PortLost
from trade_drivers.joints.serial import Answer, BadAnswer, NoAnswer, RequestRefused
from trade_drivers.joints.serial._wire import BROADCAST, ServoWire
from trade_drivers.vendors.dynamixel._table import BAUD_CODES, STATUS_ERRORS

HEADER: Final = b"\xff\xff\xfd"
STUFFED: Final = b"\xff\xff\xfd\xfd"
STATUS: Final = 0x55
OVERHEAD: Final = 11
"""Bytes of a status packet without parameters."""
_PREFIX: Final = 7
_LONGEST: Final = 1024

_ALERT: Final = 0x80
_PING_ALL: Final = b"\xff\xff\xfd\x00\xfe\x03\x00\x01"
_EACH_S: Final = 0.003
"""The time slot of each servo's answer to a broadcast ping, in the order of ids."""
_SILENT_S: Final = 0.050


class Corrupt(Exception):
    """The CRC of a packet is wrong."""


def _table() -> tuple[int, ...]:
    entries: list[int] = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
        entries.append(crc)
    return tuple(entries)


_CRC: Final = _table()


def crc16(data: Iterable[int], crc: int = 0) -> int:
    """Returns the CRC-16 with polynomial 0x8005, start value 0 and no reflection, as the e-Manual defines it."""
    table = _CRC
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ table[(crc >> 8) ^ byte]
    return crc


def take_status(buffer: bytearray) -> bytes | None:
    """Removes the first complete status packet, and noise before it, from the buffer; None while it is incomplete.

    Raises:
        Corrupt: a packet with a wrong CRC was removed.
    """
    while True:
        start = buffer.find(HEADER)
        if start < 0:
            del buffer[: max(0, len(buffer) - 2)]  # the end may be a partial header
            return None
        if start:
            del buffer[:start]
        if len(buffer) <= _PREFIX:
            return None
        length = buffer[5] | buffer[6] << 8
        if buffer[3] != 0 or buffer[_PREFIX] != STATUS or not OVERHEAD - _PREFIX <= length <= _LONGEST:
            del buffer[0]  # an instruction's echo, or noise that looks like a header
            continue
        end = _PREFIX + length
        if len(buffer) < end:
            return None
        frame = bytes(buffer[:end])
        del buffer[:end]
        if crc16(frame[:-2]) != frame[-2] | frame[-1] << 8:
            raise Corrupt
        return frame


def unstuffed(frame: bytes) -> bytes:
    """Returns the packet without the stuffing bytes that keep headers out of its parameters."""
    if STUFFED not in frame[_PREFIX:-2]:
        return frame
    return frame[:_PREFIX] + frame[_PREFIX:-2].replace(STUFFED, HEADER) + frame[-2:]


class _QuietPort(PortHandler):
    """Our line as the SDK's port."""

    expected: int | None = None
    """Required size of the answer's parameters; another size is a late answer to an earlier request."""

    def __init__(self, line: SerialLine, path: str) -> None:
        super().__init__(path)
        self._line = line

    @property
    def is_using(self) -> bool:
        """Always False: the library's "busy" stays set after a call has raised, and only one thread uses the line."""
        return False

    @is_using.setter
    def is_using(self, _: bool) -> None: ...

    def clearPort(self) -> None:  # noqa: N802
        self._line.flush()

    def writePort(self, packet: Sequence[int]) -> int:  # noqa: N802
        return self._line.write(bytes(packet))

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        self._line.expect(packet_length)

    def frame(self) -> bytes | None:
        """Returns the next status packet of the expected length, or None at the timeout; raises Corrupt if damaged."""
        while True:
            frame = take_status(self._line.received)
            if frame is None:
                if self._line.more():
                    continue
                if self._line.received:
                    raise Corrupt
                return None
            frame = frame if frame[4] == BROADCAST else unstuffed(frame)
            if self.expected is None or len(frame) == OVERHEAD + self.expected or frame[8] & ~_ALERT:
                return frame


class _Packets(Protocol2PacketHandler):
    """The SDK's protocol 2.0; parses each packet at once, and never sends one with a header in its parameters."""

    def updateCRC(self, crc_accum: int, data_blk_ptr: Sequence[int], data_blk_size: int) -> int:  # noqa: N802
        return crc16(data_blk_ptr[:data_blk_size], crc_accum)

    def addStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        # The SDK discards the stuffed packet and sends the bare one, which a servo misreads.
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
        return (b"", COMM_RX_TIMEOUT) if frame is None else (frame, COMM_SUCCESS)


class Wire(ServoWire):
    """One serial port and the packets on it; with ``fast``, one combined packet answers a sync read."""

    def __init__(self, path: str, baud: int, where: str = "bus", *, fast: bool = False) -> None:
        super().__init__(path, baud, where)
        self._baud = baud
        self._fast = fast
        self._port = _QuietPort(self._line, path)
        self._packets = _Packets()

    def open(self) -> None:
        if self._port.getCFlagBaud(self._baud) <= 0:
            problem = f"{self._baud} cannot be set; the servos know {', '.join(map(str, BAUD_CODES))}"
            raise self._wrong("baud", problem)
        super().open()

    def ping(self, device_id: int) -> int:
        with self._exchange(device_id):
            self._port.expected = 3
            model, result, _ = self._packets.ping(self._port, device_id)
            self._require(result, device_id)
        return int(model)

    def anybody(self) -> bool:
        """Returns whether any device answers a broadcast ping, after all answers could have arrived."""
        self._settle()
        crc = crc16(_PING_ALL)
        window_s = 252 * (_EACH_S + (OVERHEAD + 3) * 10 / self._baud)
        until = time.monotonic() + window_s
        with self._use():
            self._line.flush()
            self._line.write(_PING_ALL + bytes((crc & 0xFF, crc >> 8)))
            heard = self._line.more(window_s)
            while heard and self._line.more(min(_SILENT_S, until - time.monotonic())):
                pass
        self._unsettle()
        return heard

    def read(self, device_id: int, address: int, size: int) -> Answer:
        with self._exchange(device_id):
            self._port.expected = size
            data, result, error = self._packets.readTxRx(self._port, device_id, address, size)
            self._require(result, device_id, error)
        return Answer(bytes(data), bool(error & _ALERT))

    def write(self, device_id: int, address: int, data: bytes, gate: Gate | None = None) -> None:
        with self._exchange(device_id, gate):
            self._port.expected = 0
            result, error = self._packets.writeTxRx(self._port, device_id, address, len(data), data)
            self._require(result, device_id, error)

    def reboot(self, device_id: int, gate: Gate | None = None) -> None:
        """Restarts one device: torque off, RAM area at its defaults."""
        with self._exchange(device_id, gate):
            self._port.expected = 0
            result, error = self._packets.reboot(self._port, device_id)
            self._require(result, device_id, error)

    def sync_write(self, address: int, data: Mapping[int, bytes], gate: Gate | None = None) -> None:
        size = len(next(iter(data.values())))
        parameters = [byte for device_id, value in data.items() for byte in (device_id, *value)]
        with self._use(gate):
            result = self._packets.syncWriteTxOnly(self._port, address, size, parameters, len(parameters))
        if result != COMM_SUCCESS:
            raise PortLost("the packet could not be written as a whole")

    def sync_read(self, address: int, size: int, ids: Sequence[int]) -> Iterator[tuple[int, Answer]]:
        self._settle()
        heard: set[int] = set()
        with self._use():
            self._port.expected = len(ids) * (size + 4) - 3 if self._fast else size
            result = self._packets.syncReadTx(self._port, address, size, ids, len(ids), self._fast)
            if result != COMM_SUCCESS:
                raise PortLost("the packet could not be written as a whole")
            for device_id, answer in self._joined(size, len(ids)) if self._fast else self._single(len(ids)):
                if device_id in ids:
                    heard.add(device_id)
                    yield device_id, answer
        if len(heard) < len(ids):
            self._unsettle()

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

    def _require(self, result: int, device_id: int, error: int = 0) -> None:
        match result:
            case 0:
                if number := error & ~_ALERT:
                    raise RequestRefused(device_id, STATUS_ERRORS.get(number, f"error number {number}"))
            case -3001:
                raise NoAnswer(device_id, 0.0)
            case -3002:
                raise BadAnswer(device_id, 0.0)
            case _:
                raise PortLost(f"the library returned {result}")
