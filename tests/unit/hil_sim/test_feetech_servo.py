"""A simulated Feetech servo under an injected clock: memory, motion, protection."""

from collections.abc import Callable
from typing import Any

import pytest

from trade_hil_sim.feetech import STS3215, Servo, Status

pytestmark = pytest.mark.virtual_time

TORQUE, ACCELERATION, GOAL, SPEED, LOCK, POSITION, OFFSET = 40, 41, 42, 46, 55, 56, 31
BY_ADDRESS = {register.address: register for register in STS3215.registers}


class Rig:
    """A servo, its clock, and its reports."""

    def __init__(self, clock: Any, **options: Any) -> None:
        self.clock = clock
        self.reported: list[str] = []
        self.servo = Servo(1, t=clock(), emit=lambda entry: self.reported.append(entry.name), **options)

    def write(self, address: int, value: int) -> None:
        self.servo.write(address, BY_ADDRESS[address].encode(value), self.clock())

    def read(self, address: int) -> int:
        register = BY_ADDRESS[address]
        return register.decode(self.servo.read(address, register.size, self.clock()))

    def pass_s(self, s: float) -> None:
        self.servo.advance(self.clock.advance(s))

    def power_cycle(self) -> None:
        self.servo.reboot(self.clock())
        self.pass_s(0.2)


@pytest.fixture
def rig(clock: Any) -> Rig:
    return Rig(clock)


def test_registers_do_not_overlap_and_defaults_are_in_range() -> None:
    end = 0
    for register in STS3215.registers:
        assert register.address >= end, register
        end = register.address + register.size
        if register.writable:
            assert (register.low or 0) <= register.default <= (register.high or 0), register


@pytest.mark.parametrize(("value", "raw"), [(-85, 0x0855), (85, 0x0055), (-2047, 0x0FFF)])
def test_the_homing_offset_has_its_sign_in_bit_11(rig: Rig, value: int, raw: int) -> None:
    rig.write(OFFSET, value)
    assert int.from_bytes(rig.servo.read(OFFSET, 2, rig.clock()), "little") == raw
    assert rig.read(POSITION) == 2048 - value


def test_a_position_below_zero_has_its_sign_in_bit_15(clock: Any) -> None:
    assert Rig(clock, position_counts=-100).servo.read(POSITION, 2, clock()) == bytes((0x64, 0x80))


def test_what_is_written_under_the_lock_lasts_until_power_off(rig: Rig) -> None:
    rig.write(21, 50)
    assert rig.read(21) == 50
    rig.power_cycle()
    assert rig.read(21) == 32


def test_what_is_written_with_the_lock_open_is_kept_and_power_closes_the_lock(rig: Rig) -> None:
    rig.write(LOCK, 0)
    rig.write(21, 50)
    rig.power_cycle()
    assert (rig.read(21), rig.read(LOCK)) == (50, 1)


def test_at_power_up_torque_is_off_and_the_torque_limit_that_of_the_EEPROM(rig: Rig) -> None:
    rig.write(LOCK, 0)
    rig.write(16, 700)
    rig.write(48, 200)
    rig.write(TORQUE, 1)
    rig.power_cycle()
    assert (rig.read(TORQUE), rig.read(48), rig.servo.device_id) == (0, 700, 1)


@pytest.mark.parametrize(("address", "value"), [(POSITION, 100), (9, 5000), (TORQUE, 7)])
def test_what_cannot_be_written_stays_as_it_is(rig: Rig, address: int, value: int) -> None:
    before = rig.read(address)
    rig.servo.write(address, value.to_bytes(BY_ADDRESS[address].size, "little"), rig.clock())
    assert rig.read(address) == before


def test_half_a_register_is_not_written(rig: Rig) -> None:
    rig.servo.write(GOAL, b"\0", rig.clock())
    assert rig.read(GOAL) == 2048
    assert rig.reported == ["refused"]


def test_it_goes_to_its_goal_at_its_speed_and_says_so_while_it_does(rig: Rig) -> None:
    rig.write(SPEED, 500)
    rig.write(ACCELERATION, 50)
    rig.write(TORQUE, 1)
    rig.write(GOAL, 3048)
    rig.pass_s(1.0)
    assert (rig.read(58), rig.read(66)) == (500, 1)
    assert 2048 + 400 < rig.read(POSITION) < 2048 + 500
    rig.pass_s(1.2)
    assert (rig.read(POSITION), rig.read(58), rig.read(66)) == (3048, 0, 0)
    assert rig.reported == ["torque_on", "motion_started", "at_rest"]


def test_a_goal_switches_torque_on_as_on_real_servos(rig: Rig) -> None:
    rig.write(GOAL, 3000)
    rig.pass_s(2)
    assert (rig.read(TORQUE), rig.read(POSITION)) == (1, 3000)
    assert rig.reported == ["torque_on", "motion_started", "at_rest"]


def test_a_servo_set_not_to_keeps_a_goal_without_torque_and_torque_moves_it_there(clock: Any) -> None:
    rig = Rig(clock, goal_switches_on=False)
    rig.write(GOAL, 3000)
    rig.pass_s(2)
    assert rig.read(POSITION) == 2048
    rig.write(TORQUE, 1)
    rig.pass_s(2)
    assert rig.read(POSITION) == 3000


def test_a_goal_outside_of_its_range_is_one_at_its_end(rig: Rig) -> None:
    rig.write(11, 3000)
    rig.write(TORQUE, 1)
    rig.write(GOAL, 4000)
    rig.pass_s(2)
    assert rig.read(POSITION) == 3000


def test_torque_128_takes_where_it_is_for_the_centre(clock: Any) -> None:
    rig = Rig(clock, position_counts=2500)
    rig.write(TORQUE, 128)
    assert (rig.read(POSITION), rig.read(OFFSET), rig.read(TORQUE)) == (2048, 452, 0)


def strain(rig: Rig) -> None:
    rig.write(TORQUE, 1)
    rig.servo.jam(True, rig.clock())
    rig.write(GOAL, 3000)
    rig.pass_s(2.1)


def test_straining_against_a_jam_is_an_overload_after_its_time(rig: Rig) -> None:
    rig.write(35, 100)
    rig.write(TORQUE, 1)
    rig.servo.jam(True, rig.clock())
    rig.write(GOAL, 3000)
    rig.pass_s(0.9)
    assert rig.servo.status == 0
    rig.pass_s(0.2)
    assert rig.servo.status == Status.OVERLOAD
    assert rig.reported[-1] == "shutdown"


def test_released_after_an_overload_it_continues_by_itself_with_its_remaining_torque(rig: Rig) -> None:
    strain(rig)
    rig.servo.jam(False, rig.clock())
    rig.pass_s(0.5)
    assert 0 < rig.read(58) <= 0.2 * STS3215.top_speed_counts_s
    assert rig.read(TORQUE) == 1


@pytest.mark.parametrize(
    "clear", [lambda rig: rig.write(TORQUE, 0), lambda rig: rig.write(GOAL, 1000)], ids=["torque off", "goal away"]
)
def test_an_overload_ends_with_torque_off_or_a_goal_away_from_it(rig: Rig, clear: Callable[[Rig], None]) -> None:
    strain(rig)
    rig.write(GOAL, 3500)
    assert rig.servo.status == Status.OVERLOAD
    clear(rig)
    assert rig.servo.status == 0


def test_too_hot_it_releases_torque_and_cooled_down_it_goes_back_by_itself(rig: Rig) -> None:
    rig.write(TORQUE, 1)
    rig.servo.set_supply(rig.clock(), temperature_c=80)
    assert (rig.servo.status, rig.read(65), rig.read(TORQUE)) == (Status.TEMPERATURE, Status.TEMPERATURE, 1)
    rig.write(GOAL, 3000)
    rig.pass_s(1)
    assert rig.read(POSITION) == 2048
    rig.servo.set_supply(rig.clock(), temperature_c=30)
    rig.pass_s(1)
    assert (rig.servo.status, rig.read(POSITION)) == (0, 3000)


def test_a_complaint_that_is_no_unload_condition_cuts_nothing(rig: Rig) -> None:
    rig.write(TORQUE, 1)
    rig.servo.set_supply(rig.clock(), voltage_v=9.0)
    rig.write(GOAL, 3000)
    rig.pass_s(1)
    assert (rig.servo.status, rig.read(POSITION)) == (Status.VOLTAGE, 3000)
