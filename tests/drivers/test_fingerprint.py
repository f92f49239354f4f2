"""A robot file may name the very devices it means; another one is refused when the robot comes up."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.conftest import Rig
from drivers.tail_rig import TailRig, tail_rig
from trade.errors import ConfigurationError, WrongDevice
from trade_hil_sim import motion_writes


@pytest.fixture
def tail(tmp_path: Path) -> Iterator[TailRig]:
    with tail_rig(tmp_path) as made:
        yield made


def refused(rig: Any) -> WrongDevice:
    with pytest.raises(WrongDevice) as error:
        rig.attach()
    return error.value


def test_a_dynamixel_servo_with_another_firmware_is_refused_and_both_are_named(rig: Rig) -> None:
    rig.configure(("id = 1\n", 'id = 1\nfirmware = "44"\n'))
    rig.plug()
    wrong = refused(rig)
    assert (wrong.key, wrong.expected, wrong.found) == ("firmware", "44", "45")
    assert 'joint."neck.pan".firmware: the robot file says 44, but the device says 45' in str(wrong)
    assert not motion_writes(rig.log)


def test_a_dynamixel_servo_with_the_firmware_of_the_file_is_attached(rig: Rig) -> None:
    rig.configure(("id = 1\n", 'id = 1\nfirmware = "45"\n'))
    rig.plug()
    assert rig.attach().motor("neck.pan")


def test_a_feetech_servo_with_another_firmware_is_refused_and_both_are_named(tail: TailRig) -> None:
    tail.configure(("id = 1\n", 'id = 1\nfirmware = "3.9"\n'))
    tail.plug()
    wrong = refused(tail)
    assert (wrong.key, wrong.expected, wrong.found) == ("firmware", "3.9", "3.10")


def test_servos_have_no_serial_number(rig: Rig) -> None:
    rig.configure(("id = 1\n", "id = 1\nserial_number = 7\n"))
    rig.plug()
    with pytest.raises(ConfigurationError, match="tell no serial number; leave this key out"):
        rig.attach()
