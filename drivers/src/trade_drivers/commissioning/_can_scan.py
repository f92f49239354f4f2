"""An open CAN bus, looked at before a robot file names its devices: who is there. Reads; commands nothing."""

from abc import abstractmethod
from collections.abc import Collection
from typing import ClassVar, Final, NoReturn, TypeVar

from trade.errors import ConfigurationError
from trade_drivers.bus.can._port import CanPort
from trade_drivers.bus.can._sniffer import Talk
from trade_drivers.commissioning._commissioner import Bench, Found

__all__ = ["CanBench"]

_LISTEN_S: Final = 1.0
"""Who commands devices, and who tells of itself, is heard within it."""

_Self = TypeVar("_Self", bound="CanBench")


class CanBench(Bench):
    """One CAN bus that nobody commands."""

    driver: ClassVar[str]
    remedy: ClassVar[str]
    """Where its devices are given their numbers and rates."""
    zero: ClassVar[str]
    """How the zero of its devices is found."""

    def __init__(self, port: CanPort, bitrate: int) -> None:
        self._port, self._bitrate, self._talk = port, bitrate, port.talk

    @classmethod
    def open(cls: type[_Self], port: str, bitrate: int) -> _Self:
        """Begin to use a bus, after listening who talks there.

        Raises:
            ConfigurationError: somebody commands its devices, there is no such interface, or a question would be a
                command there.
            PortLost: it is not there, or down.
        """
        wire = CanPort(port, bitrate, "", _LISTEN_S, cls.orders)
        wire.open()
        try:
            bench = cls(wire, bitrate)
            bench.refuse()
        except BaseException:
            wire.close()
            raise
        return bench

    @staticmethod
    @abstractmethod
    def orders(talk: Talk) -> Collection[int]:
        """What of it comes from somebody who commands or asks such devices."""

    def refuse(self) -> None:
        """ODrives would take questions that are not theirs for commands. Raises ``ConfigurationError``."""
        if nodes := self._talk.odrives:
            numbers = ", ".join(map(str, sorted(nodes)))
            problem = f"ODrives talk on this bus (node {numbers}) and would take its questions for commands"
            raise ConfigurationError(where=f"driver {self.driver}", problem=problem)

    def found(
        self,
        device_id: int,
        model: str = "",
        *,
        firmware: str = "",
        serial_number: int | None = None,
        torque: bool | None = None,
        problem: str = "",
    ) -> Found:
        """A device of this bus."""
        return Found(
            driver=self.driver,
            wire="can",
            baud=self._bitrate,
            id=device_id,
            model=model,
            firmware=firmware,
            serial_number=serial_number,
            torque=torque,
            problem=problem,
        )

    def angle_rad(self, device_id: int) -> NoReturn:
        self._cannot(device_id, self.zero)

    def write_id(self, device_id: int, to: int) -> NoReturn:  # noqa: ARG002
        self._cannot(device_id, f"its number is set by {self.remedy}")

    def write_baud(self, device_id: int, to: int) -> NoReturn:  # noqa: ARG002
        self._cannot(device_id, f"its bit rate is set by {self.remedy}")

    def seal(self, device_id: int) -> None:
        """Nothing was opened."""

    def _cannot(self, device_id: int, problem: str) -> NoReturn:
        raise ConfigurationError(where=f"{self._port.path}, node {device_id}", problem=problem)

    def close(self) -> None:
        self._port.close()
