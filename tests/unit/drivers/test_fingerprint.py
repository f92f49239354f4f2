"""A robot file may name the very devices it means; another one is refused when the robot comes up."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Rig
from tests.unit.drivers.tail_rig import TailRig
from trade.errors import ConfigurationError, DeviceFault, DeviceSilent, WrongDevice
from trade_drivers import Motor
from trade_hil_sim import BrownOut, motion_writes

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def tail(tmp_path: Path) -> Iterator[TailRig]:
    with ExitStack() as undo:
        yield TailRig(tmp_path, undo)


def refused(rig: Any) -> WrongDevice:
    with pytest.raises(WrongDevice) as error:
        rig.attach()
    return error.value


def test_a_dynamixel_servo_with_another_firmware_is_refused_and_both_are_named(rig: Rig) -> None:
    rig.plug()
    rig.configure(("id = 1\n", 'id = 1\nfirmware = "44"\n'))
    wrong = refused(rig)
    assert (wrong.key, wrong.expected, wrong.found) == ("firmware", "44", "45")
    assert 'joint."neck.pan".firmware: the robot file says 44, but the device says 45' in str(wrong)
    assert not motion_writes(rig.log)


def test_a_dynamixel_servo_with_the_firmware_of_the_file_is_attached(rig: Rig) -> None:
    rig.configure(("id = 1\n", 'id = 1\nfirmware = "45"\n'))
    rig.plug()
    assert rig.attach().motor("neck.pan")


def test_a_feetech_servo_with_another_firmware_is_refused_and_both_are_named(tail: TailRig) -> None:
    tail.plug()
    tail.configure(("id = 1\n", 'id = 1\nfirmware = "3.9"\n'))
    wrong = refused(tail)
    assert (wrong.key, wrong.expected, wrong.found) == ("firmware", "3.9", "3.10")


def test_servos_have_no_serial_number(rig: Rig) -> None:
    rig.configure(("id = 1\n", "id = 1\nserial_number = 7\n"))
    rig.plug()
    with pytest.raises(ConfigurationError, match="report no serial number; remove this key"):
        rig.attach()


@pytest.mark.parametrize("counts", [-100, 0, 100])
def test_a_dynamixel_servo_whose_zero_was_moved_is_refused_and_both_are_named(rig: Rig, counts: int) -> None:
    rig.configure(("id = 1\n", "id = 1\nhoming_counts = 7\n"))
    rig.plug()
    rig.sim.devices[0].write(20, counts.to_bytes(4, "little", signed=True), time.monotonic())
    wrong = refused(rig)
    assert (wrong.key, wrong.expected, wrong.found) == ("homing_counts", "7", str(counts))
    said = f"its homing offset (register 20) is {counts}, but 7 in the robot file: its zero has moved"
    assert f"{said}, or this is the calibration of another arm" in str(wrong)


def test_a_servo_with_the_homing_offset_of_the_file_is_attached_and_enabled(tail: TailRig) -> None:
    tail.configure(("id = 1\n", "id = 1\nhoming_counts = -100\n"))
    tail.plug()
    tail.poke(31, 0x64, 0x08)
    tail.root().enable()


def test_a_homing_offset_lost_without_power_is_noticed_before_torque_is_on(tail: TailRig) -> None:
    tail.plug()
    tail.configure(("id = 1\n", "id = 1\nhoming_counts = 100\n"))
    tail.poke(55, 1)  # the lock: what is written now is not kept
    tail.poke(31, 100, 0)
    root = tail.root()
    tail.sim.do(BrownOut(ids=(1,)))
    wait_until(lambda: tail.events("booted", 1), "it has booted")
    wait_until(lambda: answers(root), "it answers")
    with pytest.raises(DeviceFault, match=r"homing offset \(register 31\) is 0, but 100 in the robot file"):
        root.enable()
    assert not tail.truth().torque


def answers(motor: Motor) -> bool:
    try:
        motor.state()
    except DeviceSilent:
        return False
    return True
