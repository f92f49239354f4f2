"""Independent programs on one interface: candump sees what was meant, cansend disturbs and misleads no device."""

import itertools
import struct

import pytest

from tests.system.socketcan.candump import RecordedLeg, cansend
from tests.unit.drivers.conftest import Outcome
from tests.unit.drivers.legs import COUNTS_PER_RAD, GO, HALT, HIP, KNEE, PATIENT, Leg, leg
from trade.errors import MotionStopped
from trade_hil_sim import LogEntry, frames

__all__ = ["leg"]

NOISE = (
    "181#",  # measurements cut short
    "181#27",
    "00000181#3706FFFFFF7F0000",  # with identifiers twice as long: of another device
    "00000581#4341600000000000",
    "00000701#7F",
    "181#R",  # asks for a measurement
    "183#3706FFFFFF7F0000",  # of no device
    "703#7F",
    "581#DEADBEEF",  # an unrequested answer, and one cut short
    "581#4341600000000000",
    "000#8103",  # "restart", to no device
    "080#",  # a SYNC that is not ours
    "7FF#0011223344556677",
)


@pytest.fixture
def rig(recorded: RecordedLeg) -> Leg:
    recorded.configure(PATIENT)
    return recorded


def of(entries: list[LogEntry], can_id: int) -> list[bytes]:
    return [entry.data for entry in entries if entry.can_id == can_id]


def test_the_frames_of_a_move_are_those_of_the_standard(leg: RecordedLeg) -> None:
    robot = leg.attach()
    robot.motor("leg.hip").move_to(0.3)
    robot.close()
    entries = leg.candump.entries()
    # CiA 301: NMT "start" of both nodes, to no other; our heartbeat "operational"
    assert set(of(entries, 0x000)) == {b"\x01\x01", b"\x01\x02"}
    assert set(of(entries, 0x77F)) == {b"\x05"}
    # 1016h:1 := node 127 within 2 s, and 6007h := quick stop without it
    assert bytes.fromhex("23161001 D0077F00") in of(entries, 0x601)
    assert bytes.fromhex("2B076000 03000000") in of(entries, 0x601)
    # CiA 402-2: shutdown, switch on, enable with halt; then bit 4, new set-point, raised once, to 0.3 rad in counts
    words = [struct.unpack("<Hi", data) for data in of(entries, 0x201)]
    assert [word for word, _ in words[:3]] == [0x0006, 0x0007, 0x010F]
    assert [counts for word, counts in words if word & GO] == [9778]
    # the drive's own words for it: operation enabled, within 0.01 rad of where it was to go
    status, position, _ = struct.unpack("<Hih", of(entries, 0x181)[-1])
    assert status & 0x6F == 0x27
    assert position / COUNTS_PER_RAD == pytest.approx(0.3, abs=0.01)
    assert not of(entries, 0x202)


def test_candump_has_recorded_what_the_simulator_logged(leg: RecordedLeg) -> None:
    robot = leg.attach()
    for joint in ("leg.hip", "leg.knee"):
        robot.motor(joint).enable()
    robot.group("leg").move_to([0.2, 0.3])
    robot.close()
    entries, logged = leg.candump.entries(), frames(leg.log)
    for can_id in (0x000, 0x181, 0x182, 0x201, 0x202, 0x301, 0x601, 0x602):
        assert of(entries, can_id) == of(logged, can_id)
        assert of(entries, can_id)


def test_a_moving_joint_is_not_misled_by_what_else_is_on_its_bus(leg: RecordedLeg) -> None:
    hip = leg.attach().motor("leg.hip")
    moving = Outcome(lambda: hip.move_to(0.9, 0.05))
    started = leg.wait_for("motion_started", HIP)
    for noise in itertools.zip_longest(*[iter(NOISE)] * 4, fillvalue="7FF#"):
        cansend(leg.interface, *noise)
        state = hip.state()
        assert (state.enabled, state.moving, state.fault) == (True, True, "")
        assert -0.01 < state.position_rad < 0.91
    assert not leg.events("at_rest", HIP, started.t)  # it was on its way all the time
    assert leg.goals(HIP) == [round(0.9 * COUNTS_PER_RAD)]
    assert not [word for word in leg.controlwords(HIP, started.t) if word & HALT]
    hip.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    assert hip.state().position_rad == pytest.approx(leg.truth(HIP).position_rad, abs=0.01)
    assert hip.move_to(0.1) == pytest.approx(0.1, abs=0.01)
    assert not leg.frames("rpdo1", KNEE)
