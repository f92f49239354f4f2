"""Who is on a CAN bus of motors, found out by listening and by questions that command nothing."""

import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import can
import pytest

from tests.unit.drivers.motor_rig import ROOT, TIP, MotorRig, motor_rig, wag
from trade.errors import ConfigurationError, WrongDevice
from trade_drivers import Commissioner, ScannedDevice, scan
from trade_drivers.bus.can import FramesById
from trade_drivers.vendors.cia402 import Cia402Driver
from trade_drivers.vendors.damiao import DamiaoDriver
from trade_drivers.vendors.odrive import OdriveDriver
from trade_hil_sim import WrongModel, frames
from trade_hil_sim.can import CanBus
from trade_hil_sim.cia402 import Drive
from trade_hil_sim.damiao import Motor
from trade_hil_sim.odrive import Axis

pytestmark = pytest.mark.virtual_time

__all__ = ["motor_rig", "wag"]

COMMISSIONERS = {"odrive": OdriveDriver.commissioner, "damiao": DamiaoDriver.commissioner}
ENABLE = {"odrive": (ROOT << 5 | 7, struct.pack("<I", 8)), "damiao": (ROOT, bytes(7 * (0xFF,) + (0xFC,)))}
MODELS = {"odrive": ("ODrive S1", "0.6.10"), "damiao": ("DM4310", "5014")}


def look(rig: MotorRig, **options: Any) -> list[ScannedDevice]:
    return scan(COMMISSIONERS[rig.kind](), rig.sim.port, **options)


@contextmanager
def talking(port: str, *messages: can.Message) -> Iterator[None]:
    """Another sender on the bus, which repeats these messages."""
    address, _, channel = port.removeprefix("socketcand:").partition("/")
    host, _, number = address.partition(":")
    ended = threading.Event()

    def talk() -> None:
        while not ended.wait(0.05):
            for message in messages:
                bus.send(message)

    with can.Bus(interface="socketcand", host=host, port=int(number), channel=channel, tcp_tune=True) as bus:
        thread = threading.Thread(target=talk, name="talking")
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


def message(can_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def test_a_scan_names_the_motors_and_commands_nothing(wag: MotorRig) -> None:
    found = look(wag)
    model, firmware = MODELS[wag.kind]
    assert [(one.id, one.model, one.firmware, one.torque, one.problem) for one in found] == [
        (ROOT, model, firmware, False, ""),
        (TIP, model, firmware, False, ""),
    ]
    assert not wag.commanded()
    said = {frame.name for frame in wag.frames() if frame.source.startswith("client")}
    assert said == {"odrive": {"ask_get_version"}, "damiao": {"read_register", "refresh"}}[wag.kind]


def test_a_motor_that_is_asked_for_alone(wag: MotorRig) -> None:
    assert [one.id for one in look(wag, ids=[TIP])] == [TIP]
    assert not look(wag, ids=[TIP + 1])


def test_a_motor_under_torque_ends_the_scan(wag: MotorRig) -> None:
    wag.sim.devices[0].watchdog_s = None  # an ODrive's
    with wag.listen() as other:
        other.send(message(*ENABLE[wag.kind]))
        wag.wait_for("torque_on", ROOT)
    with pytest.raises(ConfigurationError, match="has its torque on"):
        look(wag)


def test_an_unknown_model_is_shown_with_its_number(wag: MotorRig) -> None:
    wag.sim.do(WrongModel(ids=(ROOT,), number=77))
    root = look(wag, ids=[ROOT])[0]
    assert "77" in root.model + root.problem
    assert root.problem


def test_their_numbers_are_set_by_other_tools(wag: MotorRig) -> None:
    with pytest.raises(ConfigurationError, match="its number is set by"):
        COMMISSIONERS[wag.kind]().set_id(wag.sim.port, 1_000_000, ROOT, 9)
    assert not wag.commanded()


def test_an_odrive_without_a_number_is_shown_by_its_serial_number() -> None:
    address = message(63 << 5 | 6, bytes((63,)) + (0x384A31).to_bytes(6, "little"))
    with CanBus([Axis(5, t=time.monotonic())]) as sim, talking(sim.port, address):
        numbered, nameless = scan(COMMISSIONERS["odrive"](), sim.port)
    assert (numbered.id, numbered.problem) == (5, "")
    assert (nameless.id, nameless.serial_number) == (63, 0x384A31)
    assert "it has no node number yet" in nameless.problem


def test_an_odrive_whose_firmware_reports_no_version_is_shown_with_that() -> None:
    beat = message(7 << 5 | 1, struct.pack("<IBBBx", 0, 1, 0, 0))
    with CanBus([]) as sim, talking(sim.port, beat):
        [old] = scan(COMMISSIONERS["odrive"](), sim.port)
    assert (old.id, old.torque) == (7, False)
    assert "older than 0.6" in old.problem


def test_two_motors_of_one_number_are_not_taken_for_one() -> None:
    twin = Motor(1, t=time.monotonic())
    with CanBus([Motor(1, t=time.monotonic())]) as sim:
        sim._attach(twin)
        [shared] = scan(COMMISSIONERS["damiao"](), sim.port, ids=[1])
    assert "two motors answer to this number" in shared.problem


def test_a_motor_that_answers_with_another_identifier_is_shown_with_it() -> None:
    fresh = Motor(1, t=time.monotonic())
    fresh._registers[7] = 0.0
    with CanBus([fresh]) as sim:
        [found] = scan(COMMISSIONERS["damiao"](), sim.port, ids=[1])
    assert "answers as 0h; set its MST_ID (register 7) to 11h" in found.problem


@pytest.mark.parametrize("commissioner", [Cia402Driver.commissioner, DamiaoDriver.commissioner])
def test_where_odrives_talk_no_other_vendor_is_asked(commissioner: Callable[[], Commissioner]) -> None:
    with CanBus([Axis(5, t=time.monotonic())]) as sim:
        with pytest.raises(ConfigurationError, match=r"ODrives talk on this bus \(node 5\)"):
            scan(commissioner(), sim.port)
        assert not [frame for frame in frames(list(sim.log.entries)) if frame.source.startswith("client")]


def test_drives_and_motors_on_one_bus_are_distinguished() -> None:
    with CanBus([Motor(2, t=time.monotonic()), Drive(9)]) as sim:
        assert [one.id for one in scan(COMMISSIONERS["damiao"](), sim.port)] == [2]
        assert [one.id for one in scan(Cia402Driver.commissioner(), sim.port, ids=[2, 9])] == [9]
        assert not scan(COMMISSIONERS["odrive"](), sim.port)


def test_what_a_canopen_node_measures_is_no_heartbeat_of_an_odrive() -> None:
    looks_like_one = struct.pack("<IBBBx", 0, 8, 0, 1)
    measured = {12 << 5 | 1: [looks_like_one] * 3}  # 181h: of node 1
    assert FramesById(measured).odrives == {12: looks_like_one}
    assert FramesById(measured | {0x701: [b"\x05"]}).odrives == {}
    assert FramesById({56 << 5 | 1: [looks_like_one] * 3}).odrives == {56: looks_like_one}  # 701h, but eight bytes


@pytest.mark.parametrize("data", [b"\0" * 7, struct.pack("<IBBBB", 0, 1, 0, 0, 1), struct.pack("<IBBBx", 0, 99, 0, 0)])
def test_other_bytes_are_not_read_as_a_heartbeat(data: bytes) -> None:
    assert FramesById({5 << 5 | 1: [data, data]}).odrives == {}


def test_one_frame_alone_identifies_no_device() -> None:
    assert FramesById({5 << 5 | 1: [struct.pack("<IBBBx", 0, 1, 0, 0)]}).odrives == {}


def test_another_firmware_than_the_files_is_refused(motor_rig: MotorRig) -> None:
    motor_rig.plug()
    motor_rig.configure(("id = 1\n", 'id = 1\nfirmware = "9.9"\n'))
    with pytest.raises(WrongDevice) as refused:
        motor_rig.attach()
    assert (refused.value.key, refused.value.expected) == ("firmware", "9.9")
    assert refused.value.found == MODELS[motor_rig.kind][1]
