"""Setting devices up before a robot file names them: who is on a line, under which id, at which rate.

Nothing here moves anything. Only ``set_id`` and ``set_baud`` write, to one device, and only while its torque is off.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import ClassVar, Final, Literal

from msgspec import Struct

from trade.errors import ConfigurationError
from trade_drivers.bus._jobs import PortLost, WireError

__all__ = ["Bench", "Commissioner", "Found", "scan"]

_ATTEMPTS: Final = 3


class Found(Struct, frozen=True, kw_only=True):
    """A device that answers."""

    driver: str
    kind: Literal["joint", "gripper", "arm"] = "joint"
    """What it is in a robot file."""
    wire: Literal["serial", "can"] = "serial"
    """What it was found on."""
    baud: int = 0
    """Bits per second; 0 where there is no such thing: the controller of an arm."""
    id: int = 0
    model: str = ""
    """As printed on it, or what number it tells if that is not known; empty if it cannot be asked."""
    firmware: str = ""
    serial_number: int | None = None
    """None if it tells none."""
    torque: bool | None = None
    """None if it cannot be asked, or has none."""
    problem: str = ""
    """Why it cannot be used like this, and what helps."""


class Bench(ABC):
    """An open line, and one device after the other on it. Whoever made it closes it."""

    @abstractmethod
    def anybody(self) -> bool:
        """Whether it is worth asking every id; True where nothing but that can tell."""

    @abstractmethod
    def look(self, device_id: int) -> Found | None:
        """Who answers to an id; None if nobody does."""

    def alone(self, device_id: int, where: str) -> Found:
        """The device behind an id, if somebody may write to it or turn it by hand.

        Raises:
            ConfigurationError: it is absent, not alone, or has torque on; ``where`` is for the message.
        """
        found = self.answering(device_id)
        if found is None:
            problem = "nobody answers; `trade scan` shows who does, and at which rate"
            raise ConfigurationError(where=where, problem=problem)
        if found.problem:
            raise ConfigurationError(where=where, problem=found.problem)
        if found.torque:
            problem = f"its torque is on ({found.model}); end what drives it, or switch off its power for a moment"
            raise ConfigurationError(where=where, problem=problem)
        return found

    def answering(self, device_id: int) -> Found | None:
        """Who answers to an id, asked three times; None if nobody does."""
        return next((found for _ in range(_ATTEMPTS) if (found := self.look(device_id)) is not None), None)

    @abstractmethod
    def angle_rad(self, device_id: int) -> float:
        """Where a device stands, from its own centre and in its own sense.

        Raises:
            WireError: it does not answer.
        """

    def homing_counts(self, device_id: int) -> int:  # noqa: ARG002 - most devices have none
        """By how much a device shifts its zero itself; 0 where that is not known.

        Raises:
            WireError: it does not answer.
        """
        return 0

    @abstractmethod
    def write_id(self, device_id: int, to: int) -> None:
        """Have it answer to another id from now on. Whether it does is for the caller to look.

        Raises:
            WireError: it refuses.
        """

    @abstractmethod
    def write_baud(self, device_id: int, to: int) -> None:
        """Have it speak at another rate from now on. Whether it does is for the caller to look.

        Raises:
            WireError: it refuses.
        """

    @abstractmethod
    def seal(self, device_id: int) -> None:
        """Shut against writes what was opened for one, where there is such a thing."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the port; more than once is fine."""


class Commissioner(ABC):
    """What a driver knows of setting up its devices. Made without arguments, and harmless to make."""

    driver: ClassVar[str]
    wire: ClassVar[Literal["serial", "can"]] = "serial"
    """What its ports are: serial devices, or ``INTERFACE:CHANNEL``."""
    ports: ClassVar[str] = "`ls -l /dev/serial/by-id` shows those there are"
    """Where to look when a port is not there."""
    bauds: ClassVar[Sequence[int]]
    """Rates its devices can be set to, those they leave the factory with first."""
    ids: ClassVar[range]

    @abstractmethod
    def open(self, port: str, baud: int) -> Bench:
        """Take a port for this process alone.

        Raises:
            ConfigurationError: the vendor library is missing, the port cannot be had, or the rate cannot be set.
            PortLost: there is no such port.
        """

    @contextmanager
    def at(self, port: str, baud: int) -> Generator[Bench, None, None]:
        """A bench, closed in the end.

        Raises:
            ConfigurationError: the port cannot be had, or was unplugged meanwhile.
        """
        try:
            bench = self.open(port, baud)
            try:
                yield bench
            finally:
                bench.close()
        except PortLost as lost:
            raise ConfigurationError(where=port, problem=f"{lost}; {self.ports}") from None

    def set_id(self, port: str, baud: int, device_id: int, to: int) -> Found:
        """Give the one device behind an id another one, which it keeps without power.

        Returns:
            The device, as it answers to its new id.

        Raises:
            ConfigurationError: it is absent, not alone, or has torque on; the new id is taken; or it did not change.
        """
        where = f"{port}, id {device_id}"
        if to not in self.ids:
            problem = f"{to} is no id; {self.ids.start} to {self.ids.stop - 1} are"
            raise ConfigurationError(where=where, problem=problem)
        with self._changing(port, baud, where) as bench:
            before = bench.alone(device_id, where)
            if to == device_id:
                return before
            if bench.answering(to) is not None:
                problem = f"id {to} is taken on this line; choose another, `trade scan` shows those that are"
                raise ConfigurationError(where=where, problem=problem)
            bench.write_id(device_id, to)
            now, stayed = bench.answering(to), bench.answering(device_id)
            for one in (now, stayed):
                if one is not None:
                    bench.seal(one.id)
        return _changed(before, now, stayed, where, f"id {to}")

    def set_baud(self, port: str, baud: int, device_id: int, to: int) -> Found:
        """Have the one device behind an id speak at another rate, which it keeps without power.

        Returns:
            The device, as it answers at its new rate.

        Raises:
            ConfigurationError: it is absent, not alone, or has torque on; its id is taken at that rate; or it did not
                change.
        """
        where = f"{port}, id {device_id}"
        if to not in self.bauds:
            problem = f"{to} is no rate of these devices; {', '.join(map(str, self.bauds))} are"
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
    told: Callable[[int, int], None] = lambda _baud, _found: None,
) -> list[Found]:
    """Who answers on a line. Nothing is written.

    Args:
        commissioner: of the driver whose devices are looked for.
        port: where; it must not be in use.
        bauds: rates to try; by default all that the devices know.
        ids: whom to ask; by default everybody, at the rates where anybody answers.
        told: called after each rate, with it and how many devices were found at it.

    Raises:
        ConfigurationError: the port cannot be had, or a device was met whose torque is on: its stop would have to wait.
    """
    found: list[Found] = []
    for baud in bauds or commissioner.bauds:
        with commissioner.at(port, baud) as bench:
            here = list(_looking(bench, ids or commissioner.ids, port)) if ids or bench.anybody() else []
        found += here
        told(baud, len(here))
    return found


def _looking(bench: Bench, ids: Collection[int], port: str) -> Iterator[Found]:
    for device_id in ids:
        if (found := bench.look(device_id)) is None:
            continue
        if found.torque:
            raise ConfigurationError(
                where=port,
                problem=f"id {device_id} ({found.model}, {found.baud} baud) has its torque on, so the scan has ended; "
                "end what drives it, or switch off its power for a moment",
            )
        yield found


def _changed(before: Found, now: Found | None, stayed: Found | None, where: str, what: str) -> Found:
    """What a device has become, if it alone has."""
    if stayed is not None and now is None:
        raise ConfigurationError(where=where, problem=f"it does not take {what}, and answers as before")
    if stayed is not None:
        problem = f"one device answers with {what} now, and one as before: two had this id. Unplug one, and scan again"
        raise ConfigurationError(where=where, problem=problem)
    if now is None:
        problem = f"it was told {what} and answers neither so nor as before; switch it off and on, and scan again"
        raise ConfigurationError(where=where, problem=problem)
    if now.problem or now.model != before.model:
        problem = f"what answers with {what} now is not what was there before: {now.problem or now.model}"
        raise ConfigurationError(where=where, problem=problem)
    return now
