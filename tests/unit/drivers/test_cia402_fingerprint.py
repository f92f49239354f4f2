"""A robot file may name the very drives it means; another one is refused when the robot comes up."""

import pytest

from tests.unit.drivers.legs import HIP, Leg, leg, rig
from trade.errors import ConfigurationError, WrongDevice

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]


def test_another_drive_of_the_same_model_is_refused_and_both_are_named(leg: Leg) -> None:
    leg.configure(("id = 1\n", "id = 1\nserial_number = 4711\n"))
    next(device for device in leg.sim.devices if device.device_id == HIP).store.set("serial_number", 4712)
    with pytest.raises(WrongDevice) as error:
        leg.attach()
    wrong = error.value
    assert (wrong.key, wrong.expected, wrong.found) == ("serial_number", "4711", "4712")
    assert not leg.announced


def test_another_firmware_of_a_drive_is_refused_and_both_are_named(leg: Leg) -> None:
    leg.configure(("id = 1\n", 'id = 1\nfirmware = "1.0"\n'))
    with pytest.raises(WrongDevice) as error:
        leg.attach()
    wrong = error.value
    assert (wrong.key, wrong.expected, wrong.found) == ("firmware", "1.0", "0.1.0")


def test_the_drive_that_the_file_means_is_attached(leg: Leg) -> None:
    leg.configure(("id = 1\n", 'id = 1\nfirmware = "0.1.0"\nserial_number = 4711\n'))
    next(device for device in leg.sim.devices if device.device_id == HIP).store.set("serial_number", 4711)
    assert leg.attach().motor("leg.hip")


def test_the_simulator_of_a_file_is_the_drive_that_it_means(rig: Leg) -> None:
    rig.configure(("id = 1\n", 'id = 1\nfirmware = "2.11b"\nserial_number = 4711\n'))
    rig.plug()
    hip = rig.attach().motor("leg.hip")
    hip.enable()
    hip.move_to(0.3)
    truth = next(device for device in rig.sim.state().devices if device.device_id == HIP)
    assert truth.position_rad == pytest.approx(0.3, abs=1e-3)


def test_a_homing_offset_is_for_servos(leg: Leg) -> None:
    leg.configure(("id = 1\n", "id = 1\nhoming_counts = 7\n"))
    with pytest.raises(ConfigurationError, match="homing_counts: is for servos; leave this key out"):
        leg.attach()
