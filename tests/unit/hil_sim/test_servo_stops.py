"""When a servo stops by itself: its watchdog, overload, heat."""

from typing import Any

import pytest

from tests.unit.hil_sim.servo_rig import GOAL, GOAL_PWM, GOAL_VELOCITY, TORQUE, VELOCITY, WATCHDOG, Rig, refused, rig
from trade_hil_sim.dynamixel import ErrorCode, HardwareError

pytestmark = pytest.mark.virtual_time

__all__ = ["refused", "rig"]


def moving(rig: Rig, watchdog: int) -> None:
    rig.write(TORQUE, 1)
    rig.write(VELOCITY, 30)
    rig.write(WATCHDOG, watchdog)
    rig.write(GOAL, 4000)


def test_s06_silence_on_the_bus_stops_it_where_it_is(rig: Rig) -> None:
    moving(rig, watchdog=15)
    began = rig.clock()
    rig.pass_s(0.299)
    assert rig.read(WATCHDOG) == 15
    rig.pass_s(10.0)
    assert rig.at("watchdog_expired") == pytest.approx(began + 0.3)
    assert rig.at("at_rest") - rig.at("watchdog_expired") < 0.01
    assert rig.read(WATCHDOG) == 255
    assert 2048 < rig.read(132) < 2500
    assert rig.read(TORQUE) == 1


def test_any_instruction_on_the_bus_feeds_the_watchdog(rig: Rig) -> None:
    moving(rig, watchdog=15)
    for _ in range(40):
        rig.pass_s(0.25)
        rig.servo.heard(rig.clock())
    assert rig.read(WATCHDOG) == 15
    assert rig.read(132) == 4000


def test_after_the_watchdog_goals_are_refused_until_0_is_written(rig: Rig, refused: Any) -> None:
    moving(rig, watchdog=5)
    rig.pass_s(2.0)
    stopped_at = rig.read(132)
    for address in (GOAL_PWM, GOAL_VELOCITY, GOAL):
        refused(ErrorCode.DATA_RANGE, rig.write, address, 100)
    refused(ErrorCode.DATA_RANGE, rig.write, WATCHDOG, 5)
    rig.write(TORQUE, 0)
    rig.write(TORQUE, 1)
    refused(ErrorCode.DATA_RANGE, rig.write, GOAL, 2048)
    rig.write(WATCHDOG, 0)
    rig.pass_s(2.0)
    assert rig.read(132) == stopped_at  # nothing continues by itself
    rig.write(GOAL, 2048)
    rig.pass_s(5.0)
    assert rig.read(132) == 2048


def test_the_watchdog_sleeps_while_torque_is_off(rig: Rig) -> None:
    rig.write(WATCHDOG, 1)
    rig.pass_s(10.0)
    assert rig.read(WATCHDOG) == 1
    rig.write(TORQUE, 1)
    rig.pass_s(0.021)
    assert rig.read(WATCHDOG) == 255


def test_torque_off_lets_it_run_out(rig: Rig) -> None:
    moving(rig, watchdog=0)
    rig.pass_s(0.5)
    rig.write(TORQUE, 0)
    rig.pass_s(1.0)
    assert rig.names()[-2:] == ["torque_off", "at_rest"]
    assert rig.read(132) < 3000


def test_a_jam_overloads_it_and_only_a_reboot_brings_torque_back(rig: Rig) -> None:
    rig.write(TORQUE, 1)
    rig.servo.jam(True, rig.clock())
    rig.write(GOAL, 3000)
    assert rig.read(126) == 1000
    assert rig.read(123) & 0x08
    rig.pass_s(1.1)
    assert (rig.read(132), rig.read(70), rig.read(TORQUE)) == (2048, HardwareError.OVERLOAD, 0)
    assert rig.servo.error_field() == 0x80
    rig.servo.jam(False, rig.clock())
    rig.write(TORQUE, 1)
    assert rig.read(TORQUE) == 0
    rig.servo.reboot(rig.clock())
    rig.pass_s(1.0)
    rig.write(TORQUE, 1)
    assert (rig.read(TORQUE), rig.read(70), rig.servo.error_field()) == (1, 0, 0)


def test_heat_shuts_it_down_and_a_wrong_voltage_only_alerts(rig: Rig) -> None:
    rig.write(TORQUE, 1)
    rig.servo.set_supply(rig.clock(), voltage_v=15.0)
    assert (rig.read(70), rig.read(TORQUE), rig.read(144)) == (HardwareError.VOLTAGE, 1, 150)
    rig.servo.set_supply(rig.clock(), temperature_c=73)
    assert (rig.read(70), rig.read(TORQUE), rig.read(146)) == (5, 0, 73)


def test_a_frozen_sensor_shows_one_place_while_the_shaft_moves(rig: Rig) -> None:
    rig.servo.freeze(True, rig.clock(), tick=True)
    tick = rig.read(120)
    moving(rig, watchdog=0)
    rig.pass_s(1.0)
    assert (rig.read(132), rig.read(128), rig.read(122), rig.read(120)) == (2048, 0, 1, tick)
    assert rig.servo.counts(rig.clock()) > 2400
    rig.servo.freeze(False, rig.clock())
    assert rig.read(132) > 2400
