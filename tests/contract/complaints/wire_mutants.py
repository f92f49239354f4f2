"""What naive code makes of bad, missing and old answers. Each changes one function."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import pytest
from dynamixel_sdk import PacketHandler, PortHandler

from tests.contract.complaints.bodies import Body
from trade.errors import DeviceError
from trade_drivers.bus._serial_port import SerialWire
from trade_drivers.joints import BusMotor, Gate
from trade_drivers.joints.serial import Answer, ServoExchange
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402 import _wire as wire
from trade_drivers.vendors.cia402._axis import DriveAxis
from trade_drivers.vendors.cia402._table import DictionaryEntry
from trade_drivers.vendors.cia402._wire import Net
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.damiao._frames import Feedback
from trade_drivers.vendors.dynamixel import _table as dynamixel
from trade_drivers.vendors.dynamixel._wire import Wire as DynamixelWire
from trade_drivers.vendors.feetech._wire import Wire as FeetechWire


def a_read_that_fails_ends_the_loop(patch: pytest.MonkeyPatch) -> None:
    def missed(self: ServoExchange, device: Any) -> None:
        raise ConnectionError("no status packet")

    patch.setattr(ServoExchange, "missed", missed)


def a_drives_frame_is_unpacked_unseen(patch: pytest.MonkeyPatch) -> None:
    take_status = DriveAxis.take_status

    def unpacked(self: DriveAxis, data: bytes, now_ns: int) -> None:
        table.STATUS.layout.unpack(data)
        take_status(self, data, now_ns)

    patch.setattr(DriveAxis, "take_status", unpacked)


def a_motors_frame_is_unpacked_unseen(patch: pytest.MonkeyPatch) -> None:
    take = DamiaoAxis.take

    def unpacked(self: DamiaoAxis, data: bytes, now_ns: int) -> None:
        Feedback.decode(data, self.ranges)
        take(self, data, now_ns)

    patch.setattr(DamiaoAxis, "take", unpacked)


def no_driver_compares_the_model(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_drivers.joints.serial._inspect.check_model", lambda *_: None)


def no_driver_compares_the_serial_number(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_drivers.vendors.cia402._verify._check_fingerprint", lambda *_: iter(()))


def the_bare_dynamixel_sdk_takes_any_device_that_obeys(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Body, "attach", lambda self: _SdkMotor(str(self.rig.sim.port)).enable())


def _zeros(wire: Any) -> Any:
    sync_read = wire.sync_read

    def filled(self: Any, address: int, size: int, ids: Sequence[int]) -> Iterator[tuple[int, Answer]]:
        answers = dict(sync_read(self, address, size, ids))
        return iter([(one, answers.get(one, Answer(bytes(size), alert=False))) for one in ids])

    return filled


def a_dynamixel_that_is_silent_reads_zero(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(DynamixelWire, "sync_read", _zeros(DynamixelWire))


def a_feetech_that_is_silent_reads_zero(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(FeetechWire, "sync_read", _zeros(FeetechWire))


def a_write_is_done_when_it_is_sent(patch: pytest.MonkeyPatch) -> None:
    def write(self: Net, node: int, entry: DictionaryEntry, value: int, gate: Gate = lambda: None) -> Iterator[None]:
        gate()
        self._port.send(table.SDO_REQUEST + node, next(wire.download(entry.index, entry.sub, entry.encode(value))).data)
        yield

    patch.setattr(Net, "write", write)


class _SdkMotor:
    """A servo by the vendor's own library; what it says of the exchange is not looked at, only the value."""

    def __init__(self, path: str) -> None:
        self._path, self._packets = path, PacketHandler(2.0)

    def enable(self) -> None:
        self._with(lambda port: self._packets.write1ByteTxRx(port, 1, dynamixel.TORQUE_ENABLE.address, 1))

    def state(self) -> SimpleNamespace:
        counts, _, _ = self._with(lambda port: self._packets.read4ByteTxRx(port, 1, dynamixel.PRESENT_POSITION.address))
        return SimpleNamespace(position_rad=(counts - dynamixel.CENTRE_COUNTS) * dynamixel.RAD_PER_COUNT)

    def _with(self, act: Callable[[PortHandler], Any]) -> Any:
        port = PortHandler(self._path)
        assert port.setBaudRate(1_000_000)
        try:
            return act(port)
        finally:
            port.closePort()


def the_bare_dynamixel_sdk(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Body, "motor", lambda self: _SdkMotor(str(self.rig.sim.port)))


def the_last_value_is_reported_without_end(patch: pytest.MonkeyPatch) -> None:
    state, last = BusMotor.state, {}

    def cached(self: BusMotor) -> Any:
        with suppress(DeviceError):
            last[self] = state(self)
        return last[self]

    patch.setattr(BusMotor, "state", cached)


def a_missing_answer_is_the_devices(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(SerialWire, "intruder", lambda self: "")


def two_names_are_two_ports(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_drivers.plugins._validate.check_ports", lambda robot, ports: None)
