"""The base class of packet protocols on a serial line of servos."""

import time
from abc import abstractmethod
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

from trade_drivers.bus._jobs import Gate, NoAnswer
from trade_drivers.bus._serial_port import SerialWire
from trade_drivers.joints.serial._axis import Answer

BROADCAST: Final = 254
_WHOLE_SECOND_ANSWER_S: Final = 0.005


class ServoWire(SerialWire):
    """One serial port and the packets on it. All exchanges but sync writes may wait until the line is settled.

    They raise ``NoAnswer`` if no complete answer arrives in time, ``RequestRefused`` for a refusal, and ``PortLost``.
    """

    @abstractmethod
    def ping(self, device_id: int) -> int:
        """Returns the model number of a device. Only answers to pings have this length."""

    @abstractmethod
    def read(self, device_id: int, address: int, size: int) -> Answer:
        """Reads bytes of one device's control table."""

    @abstractmethod
    def write(self, device_id: int, address: int, data: bytes, gate: Gate | None = None) -> None:
        """Writes to one device's control table, with confirmation."""

    @abstractmethod
    def sync_write(self, address: int, data: Mapping[int, bytes], gate: Gate | None = None) -> None:
        """Writes the same registers of several devices in one packet without answers. Never waits."""

    @abstractmethod
    def sync_read(self, address: int, size: int, ids: Sequence[int]) -> Iterator[tuple[int, Answer]]:
        """Reads the same registers of several devices; yields the valid answers as they arrive."""

    def answers_twice(self) -> bool:
        """Returns whether bytes follow the last answer, as they do when two devices share an id."""
        with self._use():
            return bool(self._line.received) or self._line.more(_WHOLE_SECOND_ANSWER_S)

    @contextmanager
    def _exchange(self, device_id: int, gate: Gate | None = None) -> Generator[None, None, None]:
        """Wraps one request after the line is settled; without an answer, the line is unsettled again."""
        self._settle()
        began = time.monotonic()
        with self._use(gate):
            try:
                yield
            except NoAnswer as silent:
                self._unsettle()
                raise type(silent)(device_id, time.monotonic() - began) from None
