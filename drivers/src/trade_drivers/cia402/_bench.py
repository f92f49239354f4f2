"""An open CAN bus, and what its nodes tell of themselves. Reads dictionaries; commands nothing."""

from collections.abc import Iterable
from itertools import islice
from typing import Final, NoReturn

from trade.errors import ConfigurationError
from trade_drivers._commission import Bench, Found
from trade_drivers.can import CanPort
from trade_drivers.cia402 import _table as table
from trade_drivers.cia402._machine import state_of
from trade_drivers.cia402._net import Answer, Net, NoAnswer, Refused

__all__ = ["DriveBench"]

_LISTEN_S: Final = 1.0
"""A driver that commands drives is heard within it."""
_AT_ONCE: Final = 8
"""Nodes asked at the same time: the queues of interfaces are short."""
_SLICE_S: Final = 0.01


class DriveBench(Bench):
    """One CAN bus."""

    def __init__(self, port: CanPort, bitrate: int) -> None:
        self._port, self._bitrate = port, bitrate
        self._net = Net(port, _nothing, _nothing)
        self._known: dict[int, Found | None] = {}

    @classmethod
    def open(cls, port: str, bitrate: int) -> "DriveBench":
        """Begin to use a bus that nobody commands.

        Raises:
            ConfigurationError: another driver does, or there is no such interface.
            PortLost: it is not there, or down.
        """
        wire = CanPort(port, bitrate, "bus")
        wire.open()
        bench = cls(wire, bitrate)
        try:
            bench.refuse_rival()
        except BaseException:
            bench.close()
            raise
        return bench

    def refuse_rival(self) -> None:
        """Listen whether somebody commands the drives."""
        heard: list[bytes] = []
        self._net.hear(table.HEARTBEAT + table.OUR_NODE, heard.append)
        self._net.take_in(_LISTEN_S, lambda: bool(heard))
        if heard:
            problem = "another driver commands the drives of this bus; stop it first"
            raise ConfigurationError(where=self._port.path, problem=problem)

    def anybody(self) -> bool:
        """Asks all nodes, some at a time, so that those that are not there cost little."""
        left = iter(range(1, table.OUR_NODE))
        while some := list(islice(left, _AT_ONCE)):
            self._ask(some)
        return any(self._known.values())

    def look(self, device_id: int) -> Found | None:
        if device_id not in self._known:
            self._ask([device_id])
        return self._known.pop(device_id)

    def _ask(self, nodes: Iterable[int]) -> None:
        asking = {node: self._looking(node) for node in nodes}
        while asking:
            for node, steps in list(asking.items()):
                try:
                    next(steps)
                except StopIteration as done:
                    self._known[node] = done.value
                    del asking[node]
            self._net.take_in(_SLICE_S)

    def _looking(self, node: int) -> Answer[Found | None]:
        try:
            kind = (yield from self._net.read(node, table.DEVICE_TYPE)) & 0xFFFF
        except NoAnswer:
            return None
        except Refused as refused:
            return self._found(node, problem=f"it refuses to be read: {refused}")
        if kind != table.DRIVE_PROFILE:
            return self._found(node, problem=f"is no CiA 402 drive: its device type (1000h) names profile {kind}")
        try:
            serial_number = yield from self._net.read(node, table.IDENTITY[3])
            statusword = yield from self._net.read(node, table.STATUSWORD)
            model = yield from self._text(node, table.DEVICE_NAME)
            firmware = yield from self._text(node, table.SOFTWARE_VERSION)
        except (NoAnswer, Refused) as bad:
            return self._found(node, problem=f"it does not tell who it is: {bad}")
        state = state_of(statusword)
        return self._found(
            node,
            model,
            firmware=firmware,
            serial_number=serial_number or None,
            torque=state is not None and state.torque,
        )

    def _text(self, node: int, index: int) -> Answer[str]:
        """A text that need not be there."""
        try:
            return (yield from self._net.read_text(node, index))
        except Refused:
            return ""

    def _found(
        self,
        node: int,
        model: str = "",
        *,
        firmware: str = "",
        serial_number: int | None = None,
        torque: bool | None = None,
        problem: str = "",
    ) -> Found:
        return Found(
            driver="cia402",
            baud=self._bitrate,
            id=node,
            model=model,
            firmware=firmware,
            serial_number=serial_number,
            torque=torque,
            problem=problem,
        )

    def angle_rad(self, device_id: int) -> NoReturn:
        self._cannot(device_id, "the zero of a drive is found by its homing")

    def write_id(self, device_id: int, to: int) -> NoReturn:  # noqa: ARG002
        self._cannot(device_id, "its node id is set by its own switches, or by the vendor's tool")

    def write_baud(self, device_id: int, to: int) -> NoReturn:  # noqa: ARG002
        self._cannot(device_id, "its bit rate is set by its own switches, or by the vendor's tool")

    def seal(self, device_id: int) -> None:
        """Nothing was opened."""

    def _cannot(self, device_id: int, problem: str) -> NoReturn:
        raise ConfigurationError(where=f"{self._port.path}, node {device_id}", problem=problem)

    def close(self) -> None:
        self._port.close()


def _nothing() -> None:
    """Nothing has to be done between frames."""
