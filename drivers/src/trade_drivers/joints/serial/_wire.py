"""The serial line of servos: what every vendor's packets are exchanged by."""

import time
from abc import abstractmethod
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

from trade_drivers.bus._jobs import Gate, NoAnswer
from trade_drivers.bus._serial_port import SerialWire
from trade_drivers.joints.serial._axis import Answer

__all__ = ["BROADCAST", "ServoWire"]

BROADCAST: Final = 254
_WHOLE_SECOND_ANSWER_S: Final = 0.005


class ServoWire(SerialWire):
    """One serial port and the packets on it. All but a sync write may wait until the line is settled.

    Raises ``NoAnswer`` where nothing whole comes in time, ``Refused`` where a device says no, ``PortLost``.
    """

    @abstractmethod
    def ping(self, device_id: int) -> int:
        """The model number of a device. Its answer is as long as no other but that of another ping."""

    @abstractmethod
    def read(self, device_id: int, address: int, size: int) -> Answer:
        """Bytes of one device's control table."""

    @abstractmethod
    def write(self, device_id: int, address: int, data: bytes, gate: Gate | None = None) -> None:
        """Change one device's control table, and hear that it did."""

    @abstractmethod
    def sync_write(self, address: int, data: Mapping[int, bytes], gate: Gate | None = None) -> None:
        """The same registers of several devices, in one packet that nobody answers. Never waits, not even to settle."""

    @abstractmethod
    def sync_read(self, address: int, size: int, ids: Sequence[int]) -> Iterator[tuple[int, Answer]]:
        """The same registers of several devices, as their answers come; who does not answer properly is left out."""

    def answers_twice(self) -> bool:
        """Whether anything follows the answer just received, as it does when two devices share an id."""
        with self._use():
            return bool(self._line.received) or self._line.more(_WHOLE_SECOND_ANSWER_S)

    @contextmanager
    def _exchange(self, device_id: int, gate: Gate | None = None) -> Generator[None, None, None]:
        """Ask one device, once the line is settled; it is not any more if no answer comes."""
        self._settle()
        began = time.monotonic()
        with self._use(gate):
            try:
                yield
            except NoAnswer as silent:
                self._unsettle()
                raise type(silent)(device_id, time.monotonic() - began) from None
