"""Setting up devices before they are in a robot file: scanning a line, and setting ids and baud rates.

Nothing here moves a device. Only ``set_id`` and ``set_baud`` write, to one device whose torque is off.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import ClassVar, Final, Literal

from msgspec import Struct

from trade.errors import ConfigurationError
from trade_drivers.bus._jobs import PortLost, WireError

_ATTEMPTS: Final = 3


class ScannedDevice(Struct, frozen=True, kw_only=True):
    """A device that answers a scan."""

    driver: str
    kind: Literal["joint", "gripper", "arm"] = "joint"
    """The kind of device in a robot file."""
    wire: Literal["serial", "can"] = "serial"
    """The port it was found on."""
    baud: int = 0
    """Bits per second; 0 for devices without a rate, such as the controller of an arm."""
    id: int = 0
    model: str = ""
    """Model as printed on the device, or the number that it reports; empty if it reports none."""
    firmware: str = ""
    serial_number: int | None = None
    """None if the device reports none."""
    counts_per_rev: float | None = None
    """Counts of a position for one turn of the motor; None if the device does not report them."""
    homing_counts: int = 0
    """The homing offset that the device applies itself, in counts."""
    torque: bool | None = None
    """None if the device has no torque, or cannot report it."""
    problem: str = ""
    """Why the device cannot be used as it is, and what to do."""


class Bench(ABC):
    """An open line, for access to one device after the other. Its creator closes it."""

    @abstractmethod
    def anybody(self) -> bool:
        """Returns False if no device can be on the line, so that no id needs to be tried."""

    @abstractmethod
    def look(self, device_id: int) -> ScannedDevice | None:
        """Returns the device that answers to an id, or None."""

    def alone(self, device_id: int, where: str) -> ScannedDevice:
        """Returns the device with an id if it is safe to write to it or to turn it by hand.

        Raises:
            ConfigurationError: the device is absent, shares its id, or has torque on; ``where`` is for the message.
        """
        found = self.answering(device_id)
        if found is None:
            problem = "no device answers; `trade scan` shows the ids and rates of those that do"
            raise ConfigurationError(where=where, problem=problem)
        if found.problem:
            raise ConfigurationError(where=where, problem=found.problem)
        if found.torque:
            problem = f"its torque is on ({found.model}); end the program that drives it, or switch off its power"
            raise ConfigurationError(where=where, problem=problem)
        return found

    def answering(self, device_id: int) -> ScannedDevice | None:
        """Returns the device that answers to an id within three attempts, or None."""
        return next((found for _ in range(_ATTEMPTS) if (found := self.look(device_id)) is not None), None)

    @abstractmethod
    def angle_rad(self, device_id: int) -> float:
        """Returns a device's position relative to its own centre, in its own direction.

        Raises:
            WireError: the device does not answer.
        """

    def homing_counts(self, device_id: int) -> int:  # noqa: ARG002 - most devices have none
        """Returns the homing offset that a device applies itself; 0 if it is not known.

        Raises:
            WireError: the device does not answer.
        """
        return 0

    @abstractmethod
    def write_id(self, device_id: int, to: int) -> None:
        """Sets a device's id. The caller must check that the device answers to it.

        Raises:
            WireError: the device refuses.
        """

    @abstractmethod
    def write_baud(self, device_id: int, to: int) -> None:
        """Sets a device's baud rate. The caller must check that the device answers at it.

        Raises:
            WireError: the device refuses.
        """

    @abstractmethod
    def seal(self, device_id: int) -> None:
        """Locks again the registers that a write unlocked, on devices with such a lock."""

    @abstractmethod
    def close(self) -> None:
        """Closes the port. Idempotent."""


class Commissioner(ABC):
    """How a driver sets up its devices; constructed without arguments and without side effects."""

    driver: ClassVar[str]
    wire: ClassVar[Literal["serial", "can"]] = "serial"
    """The form of its ports: a serial device, or ``INTERFACE:CHANNEL``."""
    ports: ClassVar[str] = "`ls -l /dev/serial/by-id` lists the ports"
    """What to check if a port does not exist."""
    bauds: ClassVar[Sequence[int]]
    """Rates that its devices support, factory defaults first."""
    ids: ClassVar[range]

    @abstractmethod
    def open(self, port: str, baud: int) -> Bench:
        """Opens a port for exclusive use.

        Raises:
            ConfigurationError: the vendor library is missing, the port cannot be opened, or the rate cannot be set.
            PortLost: there is no such port.
        """

    @contextmanager
    def at(self, port: str, baud: int) -> Generator[Bench, None, None]:
        """Opens a bench and closes it at the end of the block.

        Raises:
            ConfigurationError: the port cannot be opened, or was unplugged meanwhile.
        """
        try:
            bench = self.open(port, baud)
            try:
                yield bench
            finally:
                bench.close()
        except PortLost as lost:
            raise ConfigurationError(where=port, problem=f"{lost}; {self.ports}") from None

    def set_id(self, port: str, baud: int, device_id: int, to: int) -> ScannedDevice:
        """Changes the id of a device permanently.

        Returns:
            The device, as it answers to its new id.

        Raises:
            ConfigurationError: the device is absent, shares its id, has torque on, or did not change; or the new id is
                taken.
        """
        where = f"{port}, id {device_id}"
        if to not in self.ids:
            problem = f"{to} is not a valid id; use {self.ids.start} to {self.ids.stop - 1}"
            raise ConfigurationError(where=where, problem=problem)
        with self._changing(port, baud, where) as bench:
            before = bench.alone(device_id, where)
            if to == device_id:
                return before
            if bench.answering(to) is not None:
                problem = f"id {to} is taken on this line; choose another, `trade scan` shows the ids in use"
                raise ConfigurationError(where=where, problem=problem)
            bench.write_id(device_id, to)
            now, stayed = bench.answering(to), bench.answering(device_id)
            for one in (now, stayed):
                if one is not None:
                    bench.seal(one.id)
        return _changed(before, now, stayed, where, f"id {to}")

    def set_baud(self, port: str, baud: int, device_id: int, to: int) -> ScannedDevice:
        """Changes the baud rate of a device permanently.

        Returns:
            The device, as it answers at its new rate.

        Raises:
            ConfigurationError: the device is absent, shares its id, has torque on, or did not change; or its id is
                taken at that rate.
        """
        where = f"{port}, id {device_id}"
        if to not in self.bauds:
            problem = f"{to} is no rate of these devices; they know {', '.join(map(str, self.bauds))}"
            raise ConfigurationError(where=where, problem=problem)
        if to != baud:
            with self._changing(port, to, where) as bench:
                if bench.answering(device_id) is not None:
                    problem = f"id {device_id} is taken at {to} baud; give one of the two another id first"
                    raise ConfigurationError(where=where, problem=problem)
        with self._changing(port, baud, where) as bench:
            before = bench.alone(device_id, where)
            if to == baud:
                return before
            bench.write_baud(device_id, to)
            if (stayed := bench.answering(device_id)) is not None:
                bench.seal(device_id)
        with self._changing(port, to, where) as bench:
            if (now := bench.answering(device_id)) is not None:
                bench.seal(device_id)
        return _changed(before, now, stayed, where, f"{to} baud")

    @contextmanager
    def _changing(self, port: str, baud: int, where: str) -> Generator[Bench, None, None]:
        with self.at(port, baud) as bench:
            try:
                yield bench
            except WireError as bad:
                raise ConfigurationError(where=where, problem=f"nothing was changed: {bad}") from None


def scan(
    commissioner: Commissioner,
    port: str,
    bauds: Sequence[int] = (),
    ids: Collection[int] = (),
    progress: Callable[[int, int], None] = lambda _baud, _found: None,
) -> list[ScannedDevice]:
    """Finds the devices on a line. Writes nothing. Calls back after each rate, with it and the number of devices found.

    Args:
        commissioner: of the driver whose devices are wanted.
        port: the port, which must not be in use.
        bauds: rates to try; by default all that the devices support.
        ids: ids to try, up to three times each; by default all, once each, at the rates where a device answers.

    Raises:
        ConfigurationError: the port cannot be opened, or a device has torque on: a scan would delay its stop.
    """
    found: list[ScannedDevice] = []
    for baud in bauds or commissioner.bauds:
        with commissioner.at(port, baud) as bench:
            if ids:
                here = list(_safe(map(bench.answering, ids), port))
            else:
                here = list(_safe(map(bench.look, commissioner.ids), port)) if bench.anybody() else []
        found += here
        progress(baud, len(here))
    return found


def _safe(answers: Iterable[ScannedDevice | None], port: str) -> Iterator[ScannedDevice]:
    for found in answers:
        if found is None:
            continue
        if found.torque:
            raise ConfigurationError(
                where=port,
                problem=f"id {found.id} ({found.model}, {found.baud} baud) has its torque on, so the scan has ended; "
                "end the program that drives it, or switch off its power",
            )
        yield found


def _changed(
    before: ScannedDevice, now: ScannedDevice | None, stayed: ScannedDevice | None, where: str, what: str
) -> ScannedDevice:
    """Returns the changed device, if it alone has changed."""
    if stayed is not None and now is None:
        raise ConfigurationError(where=where, problem=f"it did not accept {what}, and answers as before")
    if stayed is not None:
        problem = f"one device answers with {what} now, another as before: two had this id. Unplug one, then scan again"
        raise ConfigurationError(where=where, problem=problem)
    if now is None:
        problem = f"after the change to {what} it does not answer at all; switch it off and on, and scan again"
        raise ConfigurationError(where=where, problem=problem)
    if now.problem or now.model != before.model:
        problem = f"the device that answers with {what} now is not the one from before: {now.problem or now.model}"
        raise ConfigurationError(where=where, problem=problem)
    return now
