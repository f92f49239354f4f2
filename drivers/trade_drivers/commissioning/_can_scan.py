"""Scanning an open CAN bus for devices before they are in a robot file. Reads only; commands nothing."""

import time
from abc import abstractmethod
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, ClassVar, Final, NoReturn, TypeVar

from trade.errors import ConfigurationError
from trade_drivers.commissioning._commissioner import Bench, ScannedDevice

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort, Frame, FramesById

_LISTEN_S: Final = 1.0
"""How long to listen for other drivers, and for devices that report by themselves."""
_ATTEMPTS: Final = 3

_Self = TypeVar("_Self", bound="CanBench")
_Value = TypeVar("_Value")


class CanBench(Bench):
    """An open CAN bus that no driver commands."""

    driver: ClassVar[str]
    remedy: ClassVar[str]
    """The tool that sets the ids and rates of its devices."""
    zero: ClassVar[str]
    """How to set the zero of its devices."""

    def __init__(self, port: "CanPort", bitrate: int) -> None:
        self._port, self._bitrate, self._sniffed = port, bitrate, port.sniffed

    @classmethod
    def open(cls: type[_Self], port: str, bitrate: int) -> _Self:
        """Opens a bus after listening for other drivers.

        Raises:
            ConfigurationError: another driver commands its devices, there is no such interface, or a device would take
                a request for a command.
            PortLost: the interface does not exist or is down.
            ImportError: python-can is missing.
        """
        from trade_drivers.bus.can import CanPort  # noqa: PLC0415 - python-can is optional

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
    def orders(sniffed: "FramesById") -> Collection[int]:
        """Returns the identifiers among the frames that only a driver of such devices sends."""

    def refuse(self) -> None:
        """Raises ``ConfigurationError`` if there are ODrives, which would take requests to others for commands."""
        if nodes := self._sniffed.odrives:
            numbers = ", ".join(map(str, sorted(nodes)))
            problem = f"ODrives talk on this bus (node {numbers}) and would take its requests for commands"
            raise ConfigurationError(where=f"driver {self.driver}", problem=problem)

    def ask(
        self,
        can_id: int,
        data: bytes,
        decode: "Callable[[Frame], _Value | None]",
        patience_s: float,
        second_s: float = 0.0,
    ) -> list[_Value]:
        """Sends a request up to three times, and returns the answers to one of them; none if nothing answers.

        After the first answer, it waits ``second_s`` for that of another device with the same number.
        """
        answers: list[_Value] = []
        for _ in range(_ATTEMPTS):
            self._port.send(can_id, data)
            until = time.monotonic() + patience_s
            while (left_s := until - time.monotonic()) > 0:
                frame = self._port.receive(left_s)
                if frame is not None and (answer := decode(frame)) is not None:
                    answers.append(answer)
                    until = min(until, time.monotonic() + second_s)
            if answers:
                break
        return answers

    def found(
        self,
        device_id: int,
        model: str = "",
        *,
        firmware: str = "",
        serial_number: int | None = None,
        counts_per_rev: float | None = None,
        torque: bool | None = None,
        problem: str = "",
    ) -> ScannedDevice:
        """Returns a record of a device on this bus."""
        return ScannedDevice(
            driver=self.driver,
            wire="can",
            baud=self._bitrate,
            id=device_id,
            model=model,
            firmware=firmware,
            serial_number=serial_number,
            counts_per_rev=counts_per_rev,
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
        """Does nothing, as this bench unlocks no registers."""

    def _cannot(self, device_id: int, problem: str) -> NoReturn:
        raise ConfigurationError(where=f"{self._port.path}, node {device_id}", problem=problem)

    def close(self) -> None:
        self._port.close()
