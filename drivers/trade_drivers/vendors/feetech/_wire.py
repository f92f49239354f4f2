"""Packets of SCS and STS servos over a serial line: their bytes, and the only wire of this folder, on pyserial.

``FF FF | ID | LEN | INST | parameters | CK``. LEN is the number of bytes from INST on. CK is the inverted sum of the
bytes between header and CK. An answer has the device's status in place of INST. There is no byte stuffing, so the
parameters may contain the bytes of a header.
"""

from collections.abc import Container, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from trade_drivers.joints import Gate, PortLost
from trade_drivers.joints.serial import Answer, BadAnswer, NoAnswer
from trade_drivers.joints.serial._wire import BROADCAST, ServoWire
from trade_drivers.vendors.feetech._table import BAUD_CODES, MODEL_NUMBER, OVERHEAD

HEADER: Final = b"\xff\xff"
_ID, _LENGTH, _STATUS = 2, 3, 4
_BEFORE_PARAMETERS: Final = 5


class Instruction:
    """The instructions that this driver sends."""

    READ: Final = 0x02
    WRITE: Final = 0x03
    SYNC_READ: Final = 0x82
    SYNC_WRITE: Final = 0x83


class Corrupt(Exception):
    """The checksum of an answer is wrong."""


class Status(NamedTuple):
    """One answer."""

    device_id: int
    status: int
    """Error bits of the device; it carries out the instruction nevertheless."""
    data: bytes


def checksum(body: bytes) -> int:
    """The checksum of the bytes between the header and the checksum."""
    return ~sum(body) & 0xFF


def packet(device_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Encodes one packet."""
    body = bytes((device_id, len(parameters) + 2, instruction)) + parameters
    return HEADER + body + bytes((checksum(body),))


def take_status(buffer: bytearray, ids: Container[int], size: int, sent: bytes = b"") -> Status | None:
    """Removes the first answer of these devices with ``size`` bytes of data from the buffer; None if it is incomplete.

    All bytes before the answer are removed, too: noise, answers of another length, and the request if the adapter
    echoes it.

    Raises:
        Corrupt: an answer with a wrong checksum was removed.
    """
    whole = OVERHEAD + size
    while True:
        start = buffer.find(HEADER)
        if start < 0:
            del buffer[: max(0, len(buffer) - 1)]  # the buffer may end with half a header
            return None
        del buffer[:start]
        if len(buffer) <= _LENGTH:
            return None
        if buffer[_ID] not in ids or buffer[_LENGTH] != size + 2:
            del buffer[0]
            continue
        if len(buffer) < whole:
            return None
        frame = bytes(buffer[:whole])
        if checksum(frame[_ID:-1]) == frame[-1]:
            del buffer[:whole]
            if frame == sent:
                continue
            return Status(frame[_ID], frame[_STATUS], frame[_BEFORE_PARAMETERS:-1])
        behind = buffer[whole : whole + len(HEADER)]
        if HEADER.startswith(behind):
            del buffer[:whole]
            raise Corrupt
        del buffer[0]  # noise that looks like a header: the answer follows


class Wire(ServoWire):
    """One serial port and the packets on it."""

    def __init__(self, path: str, baud: int, where: str = "bus") -> None:
        super().__init__(path, baud, where)
        self._baud = baud
        self._sent = b""

    def open(self) -> None:
        if self._baud not in BAUD_CODES:
            problem = f"{self._baud} is no rate of these servos; they know {', '.join(map(str, sorted(BAUD_CODES)))}"
            raise self._wrong("baud", problem)
        super().open()

    def ping(self, device_id: int) -> int:
        # the protocol's ping returns no model, and its answer is as long as that to a write
        return MODEL_NUMBER.decode(
            self.read(device_id, MODEL_NUMBER.address, MODEL_NUMBER.size).data, MODEL_NUMBER.address
        )

    def read(self, device_id: int, address: int, size: int) -> Answer:
        return self._ask(device_id, Instruction.READ, bytes((address, size)), size)

    def write(self, device_id: int, address: int, data: bytes, gate: Gate | None = None) -> None:
        self._ask(device_id, Instruction.WRITE, bytes((address,)) + data, 0, gate)

    def sync_write(self, address: int, data: Mapping[int, bytes], gate: Gate | None = None) -> None:
        size = len(next(iter(data.values())))
        values = b"".join(bytes((device_id,)) + value for device_id, value in data.items())
        with self._use(gate):
            self._send(packet(BROADCAST, Instruction.SYNC_WRITE, bytes((address, size)) + values))

    def sync_read(self, address: int, size: int, ids: Sequence[int]) -> Iterator[tuple[int, Answer]]:
        self._settle()
        heard: set[int] = set()
        with self._use():
            self._line.flush()
            self._send(packet(BROADCAST, Instruction.SYNC_READ, bytes((address, size, *ids))))
            self._line.expect(len(ids) * (OVERHEAD + size))
            for _ in ids:
                try:
                    status = self._next(ids, size)
                except Corrupt:
                    continue
                if status is None:
                    break
                heard.add(status.device_id)
                yield status.device_id, Answer(status.data, bool(status.status))
        if len(heard) < len(ids):
            self._unsettle()

    def _ask(self, device_id: int, instruction: int, parameters: bytes, size: int, gate: Gate | None = None) -> Answer:
        """Sends a request to one device, and returns its answer with a given size of data."""
        with self._exchange(device_id, gate):
            self._line.flush()
            self._send(packet(device_id, instruction, parameters))
            self._line.expect(OVERHEAD + size)
            try:
                status = self._next((device_id,), size)
            except Corrupt:
                raise BadAnswer(device_id, 0.0) from None
            if status is None:
                raise (BadAnswer if self._line.received else NoAnswer)(device_id, 0.0)
        return Answer(status.data, bool(status.status))

    def _next(self, ids: Container[int], size: int) -> Status | None:
        """Returns the next answer to the request; None at the timeout."""
        while (status := take_status(self._line.received, ids, size, self._sent)) is None and self._line.more():
            pass
        return status

    def _send(self, data: bytes) -> None:
        self._sent = data
        if self._line.write(data) != len(data):
            raise PortLost("the packet could not be written as a whole")
