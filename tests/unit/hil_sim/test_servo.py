"""One servo under an injected clock: what it accepts, and how it moves."""

from math import tau
from typing import Any

import pytest

from tests.unit.hil_sim.servo_rig import (
    ACCELERATION,
    GOAL,
    GOAL_PWM,
    GOAL_VELOCITY,
    TORQUE,
    VELOCITY,
    WATCHDOG,
    Rig,
    refused,
    rig,
)
from trade_hil_sim import XL430_W250, XM430_W350
from trade_hil_sim.dynamixel import ErrorCode, Servo

pytestmark = pytest.mark.virtual_time

__all__ = ["refused", "rig"]


# what may be written


def test_it_starts_with_torque_off_in_position_mode_and_its_goal_where_it_is(clock: Any) -> None:
    rig = Rig(clock, position_counts=1000)
    assert (rig.read(TORQUE), rig.read(11), rig.read(132), rig.read(GOAL)) == (0, 3, 1000, 1000)


def test_eeprom_is_locked_while_torque_is_on(rig: Rig, refused: Any) -> None:
    rig.write(11, 4)
    rig.write(TORQUE, 1)
    refused(ErrorCode.ACCESS, rig.write, 11, 3)
    rig.write(TORQUE, 0)
    rig.write(11, 3)
    assert rig.read(11) == 3


def test_refusals_carry_the_manuals_numbers(rig: Rig, refused: Any) -> None:
    refused(ErrorCode.ACCESS, rig.write, 132, 0)  # read-only
    refused(ErrorCode.ACCESS, rig.write, 200, 0, 800)  # past the end
    refused(ErrorCode.ACCESS, rig.servo.read, 660, 4, 0.0)
    refused(ErrorCode.ACCESS, rig.servo.read, 15, 2, 0.0)  # nothing there
    refused(ErrorCode.DATA_LENGTH, rig.write, GOAL, 5, 2)  # half a register
    refused(ErrorCode.DATA_RANGE, rig.write, TORQUE, 2)
    refused(ErrorCode.DATA_RANGE, rig.write, WATCHDOG, 128)
    refused(ErrorCode.DATA_RANGE, rig.write, 11, 5)  # current control is the XM's
    refused(ErrorCode.DATA_LIMIT, rig.write, GOAL, 4096)
    refused(ErrorCode.DATA_LIMIT, rig.write, GOAL_VELOCITY, -266)
    refused(ErrorCode.DATA_LIMIT, rig.write, GOAL_PWM, 886)


def test_goal_position_is_limited_by_the_limit_registers_in_position_mode_only(rig: Rig, refused: Any) -> None:
    rig.write(52, 1000)
    rig.write(48, 3000)
    refused(ErrorCode.DATA_LIMIT, rig.write, GOAL, 999)
    rig.write(GOAL, 3000)
    rig.write(11, 4)
    rig.write(GOAL, -100_000)
    refused(ErrorCode.DATA_LIMIT, rig.write, GOAL, 2_000_000)


def test_a_write_over_several_registers_is_done_whole_or_not_at_all(rig: Rig, refused: Any) -> None:
    good = (10).to_bytes(4, "little") + (20).to_bytes(4, "little") + (3000).to_bytes(4, "little")
    bad = (11).to_bytes(4, "little") + (21).to_bytes(4, "little") + (9999).to_bytes(4, "little")
    rig.servo.write(ACCELERATION, good, rig.clock())
    refused(ErrorCode.DATA_LIMIT, rig.servo.write, ACCELERATION, bad, rig.clock())
    assert (rig.read(ACCELERATION), rig.read(VELOCITY), rig.read(GOAL)) == (10, 20, 3000)


def test_eeprom_survives_a_power_cycle_and_ram_does_not(rig: Rig) -> None:
    rig.write(24, 33)
    rig.write(65, 1)
    rig.servo.reboot(rig.clock(), "brown_out")
    assert not rig.servo.hears
    rig.pass_s(1.0)
    assert rig.servo.hears
    assert (rig.read(24), rig.read(65)) == (33, 0)
    assert rig.names() == ["brown_out", "booted"]


def test_a_factory_reset_spares_the_requested_settings(clock: Any) -> None:
    for option, expected in ((0xFF, (1, 57_600)), (1, (7, 57_600)), (2, (7, 1_000_000))):
        servo = Servo(7, baud=1_000_000)
        servo.write(24, (33).to_bytes(4, "little"), 0.0)
        servo.factory_reset(option, 0.0)
        servo.advance(1.0)
        assert (servo.device_id, servo.baud) == expected
        assert servo.memory.get("moving_threshold") == 10


def test_changing_the_mode_resets_gains_profile_and_goals(rig: Rig) -> None:
    rig.write(84, 1)
    rig.write(VELOCITY, 50)
    rig.write(11, 16)
    assert (rig.read(84), rig.read(VELOCITY), rig.read(GOAL_PWM)) == (640, 0, 0)
    rig.write(11, 1)
    assert rig.read(GOAL_PWM) == 885


def test_indirect_data_is_its_target(rig: Rig, refused: Any) -> None:
    for k, address in enumerate((132, 133, 134, 135, 70)):
        rig.write(168 + 2 * k, address)
    assert rig.servo.read(224, 5, rig.clock()) == (2048).to_bytes(4, "little") + b"\0"
    refused(ErrorCode.ACCESS, rig.write, 228, 0)  # register 70 is read-only by any way
    for k in range(4):
        rig.write(578 + 2 * k, GOAL + k)
    rig.servo.write(634, (2100).to_bytes(4, "little"), rig.clock())
    assert rig.read(GOAL) == 2100
    assert rig.servo.memory.touched(634, 4) == ("goal_position",)


def test_reg_write_waits_for_action(rig: Rig, refused: Any) -> None:
    rig.servo.reg_write(65, b"\1")
    assert (rig.read(65), rig.read(69)) == (0, 1)
    rig.servo.action(rig.clock())
    assert (rig.read(65), rig.read(69)) == (1, 0)
    refused(ErrorCode.INSTRUCTION, rig.servo.action, rig.clock())


# how it moves


def test_without_torque_a_goal_moves_nothing_and_switching_on_goes_for_it(rig: Rig) -> None:
    """The harder reading of the manual: enabling without seeding the goal causes a jump."""
    rig.write(GOAL, 3000)
    rig.pass_s(1.0)
    assert rig.read(132) == 2048
    rig.write(TORQUE, 1)
    rig.pass_s(1.0)
    assert rig.read(132) == 3000


def test_a_profile_is_kept_and_shown_while_it_moves(rig: Rig) -> None:
    rig.write(TORQUE, 1)
    rig.write(VELOCITY, 40)
    rig.write(ACCELERATION, 10)
    rig.write(GOAL, 4000)
    began, fastest = rig.clock(), 0
    while rig.servo.shaft.moving(rig.clock()):
        assert rig.read(122) == 1
        assert rig.read(123) & 0x33 == 0x32
        fastest = max(fastest, rig.read(128))
        rig.pass_s(0.01)
    assert fastest == 40
    assert (rig.read(132), rig.read(122), rig.read(123) & 0x03) == (4000, 0, 1)
    speed, rate = 40 * 0.229 * 4096 / 60, 10 * 214.577 * 4096 / 3600
    expected = (4000 - 2048) / speed + speed / rate
    assert rig.at("motion_started") == began
    assert rig.at("at_rest") - began == pytest.approx(expected)


def test_speed_and_acceleration_are_in_the_manuals_units(rig: Rig) -> None:
    """1 unit is 0.229 rev/min, and 214.577 rev/min^2."""
    rig.write(11, 1)
    rig.write(TORQUE, 1)
    rig.write(ACCELERATION, 10)
    rig.write(GOAL_VELOCITY, 100)
    rig.pass_s(0.1)
    assert rig.servo.shaft.speed(rig.clock()) * tau / 4096 == pytest.approx(10 * 214.577 / 3600 * tau * 0.1)
    rig.pass_s(10.0)
    assert rig.read(128) == 100
    assert rig.servo.shaft.speed(rig.clock()) / 4096 * 60 == pytest.approx(22.9)


def test_a_time_based_profile_takes_its_time(rig: Rig) -> None:
    rig.write(10, 4)
    rig.write(TORQUE, 1)
    rig.write(VELOCITY, 2000)
    rig.write(ACCELERATION, 500)
    began = rig.clock()
    rig.write(GOAL, 3000)
    rig.pass_s(10.0)
    assert rig.at("at_rest") - began == pytest.approx(2.0)


def test_velocity_mode_turns_on_past_a_turn_and_extended_position_mode_finds_back(rig: Rig) -> None:
    rig.write(11, 1)
    rig.write(TORQUE, 1)
    rig.write(GOAL_VELOCITY, -200)
    rig.pass_s(5.0)
    assert rig.read(132, signed=True) < -4096
    rig.write(TORQUE, 0)
    rig.pass_s(1.0)
    rig.write(11, 4)
    rig.write(TORQUE, 1)
    rig.write(GOAL, -100)
    rig.pass_s(20.0)
    assert rig.read(132, signed=True) == -100


def test_clear_forgets_whole_turns_but_not_while_moving(rig: Rig, refused: Any) -> None:
    rig.write(11, 4)
    rig.write(TORQUE, 1)
    rig.write(GOAL, 10_000)
    refused(ErrorCode.RESULT_FAIL, rig.servo.clear, b"\x01DXL\x22", rig.clock())
    rig.pass_s(20.0)
    rig.servo.clear(b"\x01DXL\x22", rig.clock())
    assert rig.read(132) == 10_000 % 4096
    refused(ErrorCode.DATA_RANGE, rig.servo.clear, b"\x01", rig.clock())


def test_pwm_mode_turns_in_proportion(rig: Rig) -> None:
    rig.write(11, 16)
    rig.write(TORQUE, 1)
    rig.write(GOAL_PWM, 885)
    rig.pass_s(2.0)
    assert rig.servo.shaft.speed(rig.clock()) / 4096 * 60 == pytest.approx(XL430_W250.no_load_rpm)


def test_reverse_mode_mirrors_about_the_centre(clock: Any) -> None:
    rig = Rig(clock, position_counts=2148)
    rig.write(10, 1)
    assert rig.read(132) == 1948
    rig.write(GOAL, 1948)
    rig.write(TORQUE, 1)
    assert rig.names() == ["torque_on"]
    rig.write(GOAL, 2000)
    rig.pass_s(1.0)
    assert (rig.read(132), rig.servo.joint_rad(clock())) == (2000, pytest.approx((2000 - 2048) * tau / 4096))


def test_a_homing_offset_shifts_what_it_shows_and_what_it_takes(rig: Rig) -> None:
    rig.write(20, -500)
    assert rig.read(132) == 1548
    rig.write(GOAL, 1600)
    rig.write(TORQUE, 1)
    rig.pass_s(1.0)
    assert rig.read(132) == 1600


def test_the_joint_angle_follows_the_robot_files_sense(clock: Any) -> None:
    rig = Rig(clock, position_counts=3072, reversed_=True, offset_rad=0.5)
    assert rig.servo.joint_rad(clock()) == pytest.approx(0.5 - tau / 4)


def test_a_goal_with_torque_off_switches_it_on_if_drive_mode_says_so(rig: Rig) -> None:
    rig.write(10, 8)
    rig.write(GOAL, 2100)
    rig.pass_s(1.0)
    assert (rig.read(TORQUE), rig.read(132)) == (1, 2100)


def test_the_tick_counts_milliseconds_and_wraps(rig: Rig) -> None:
    rig.pass_s(1.5)
    assert rig.read(120) == pytest.approx(1500, abs=1)
    rig.pass_s(32.768)
    assert rig.read(120) == pytest.approx(1500, abs=1)


def test_a_second_model_has_its_own_registers(clock: Any) -> None:
    rig = Rig(clock, model=XM430_W350)
    assert (rig.read(0), rig.read(38), rig.read(102), rig.read(44)) == (1020, 1193, 1193, 200)
    rig.write(11, 5)
    rig.write(TORQUE, 1)
    rig.write(GOAL, 5000)
    rig.pass_s(10.0)
    assert rig.read(132) == 5000
