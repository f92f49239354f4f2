"""Scanning an open CAN bus for nodes. Reads dictionaries; commands nothing."""

from collections.abc import Iterable
from itertools import islice
from typing import Final

from trade_drivers.bus.can import CanPort, Listeners
from trade_drivers.commissioning._can_scan import CanBench
from trade_drivers.commissioning._commissioner import ScannedDevice
from trade_drivers.joints import DeviceUnusable
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._table import state_of
from trade_drivers.vendors.cia402._units import read_scale
from trade_drivers.vendors.cia402._wire import Answer, DriveRefused, Net, NoAnswer

_AT_ONCE: Final = 8
"""Number of simultaneous requests, as the queues of interfaces are short."""
_SLICE_S: Final = 0.01
_STOPPED: Final = "network management has stopped it, and it answers nothing; a driver that attaches takes it back"


class DriveBench(CanBench):
    """One CAN bus with CiA 402 drives."""

    driver = "cia402"
    remedy = "its own switches, or by the vendor's tool"
    zero = "the zero of a drive is found by its homing"

    orders = staticmethod(table.orders)

    def __init__(self, port: CanPort, bitrate: int) -> None:
        super().__init__(port, bitrate)
        self._listeners = Listeners(port, _nothing, _nothing)
        self._net = Net(self._listeners)
        self._known: dict[int, ScannedDevice | None] = {}

    def anybody(self) -> bool:
        """Scans nodes in batches, so that absent ones cost little time."""
        left = iter(range(1, table.OUR_NODE))
        while some := list(islice(left, _AT_ONCE)):
            self._ask(some)
        return any(self._known.values())

    def look(self, device_id: int) -> ScannedDevice | None:
        if device_id not in self._known:
            self._ask([device_id])
        return self._known.pop(device_id)

    def _ask(self, nodes: Iterable[int]) -> None:
        asking = {node: self._identify(node) for node in nodes}
        while asking:
            for node, steps in list(asking.items()):
                try:
                    next(steps)
                except StopIteration as done:
                    self._known[node] = done.value
                    del asking[node]
            self._listeners.take_in(_SLICE_S)

    def _identify(self, node: int) -> Answer[ScannedDevice | None]:
        try:
            kind = (yield from self._net.read(node, table.DEVICE_TYPE)) & 0xFFFF
        except NoAnswer:
            beats = self._sniffed.frames.get(table.HEARTBEAT + node, ())
            return self.found(node, problem=_STOPPED) if bytes((table.STOPPED,)) in beats[-1:] else None
        except DriveRefused as refused:
            return self.found(node, problem=f"it refuses to be read: {refused}")
        if kind != table.DRIVE_PROFILE:
            return self.found(node, problem=f"is no CiA 402 drive: its device type (1000h) names profile {kind}")
        try:
            serial_number = yield from self._net.read(node, table.IDENTITY[3])
            statusword = yield from self._net.read(node, table.STATUSWORD)
            model = yield from self._text(node, table.DEVICE_NAME)
            firmware = yield from self._text(node, table.SOFTWARE_VERSION)
            scale = yield from read_scale(self._net, node)
        except (NoAnswer, DriveRefused) as bad:
            return self.found(node, problem=f"it does not tell who it is: {bad}")
        except DeviceUnusable as unfit:
            return self.found(node, problem=str(unfit))
        state = state_of(statusword)
        return self.found(
            node,
            model,
            firmware=firmware,
            serial_number=serial_number or None,
            counts_per_rev=scale.counts_per_rev,
            torque=state is not None and state.torque,
        )

    def _text(self, node: int, index: int) -> Answer[str]:
        """Reads an optional text."""
        try:
            return (yield from self._net.read_text(node, index))
        except DriveRefused:
            return ""


def _nothing() -> None:
    """Does nothing between frames."""
