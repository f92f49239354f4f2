"""The simulated 2F-85 by itself, on a clock that the test turns."""

import pytest

from tests.unit.hil_sim.conftest import FakeClock
from trade_hil_sim.robotiq import Gripper, Object

pytestmark = pytest.mark.virtual_time

COMMAND, STATUS = 0x03E8, 0x07D0
ACTIVE, GOING = 0x31, 0x39
CYCLE_S = 0.005


class Hand:
    """A gripper, its clock, and what it did."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.gripper = Gripper(t=clock.now)
        self.did: list[str] = []
        self.gripper.emit = lambda entry: self.did.append(entry.name)

    def tell(self, *values: int, s: float = 2 * CYCLE_S) -> None:
        assert self.gripper.write(COMMAND, values, self.clock.now)
        self.wait(s)

    def wait(self, s: float) -> None:
        self.gripper.advance(self.clock.advance(s))

    @property
    def status(self) -> tuple[int, int, int, int]:
        """Status byte, fault, echo of the position request, position."""
        first, second, third = self.gripper.status(self.clock.now)
        return first >> 8, second >> 8, second & 0xFF, third >> 8

    @property
    def contact(self) -> int:
        return self.status[0] >> 6


@pytest.fixture
def raw(clock: FakeClock) -> Hand:
    return Hand(clock)


@pytest.fixture
def hand(raw: Hand) -> Hand:
    """Activated, and open."""
    raw.tell(0x0100, 0, 0, s=5.0)
    raw.did.clear()
    return raw


def test_it_powers_up_not_activated(raw: Hand) -> None:
    assert raw.status == (0, 0, 0, 3)


def test_activation_moves_the_fingers_both_ways_and_ends_open(raw: Hand) -> None:
    raw.tell(0x0100, 0, 0)
    seen = [raw.status[3]]
    assert raw.status[0] == 0x11
    while raw.status[0] == 0x11:
        raw.wait(0.02)
        seen.append(raw.status[3])
    assert raw.status == (ACTIVE, 0, 0, 3)
    assert max(seen) > 220
    assert raw.did == ["activating", "motion_started", "activated", "at_rest"]


def test_a_command_during_activation_is_delayed_and_carried_out_after_it(raw: Hand) -> None:
    raw.tell(0x0900, 100, 0xFFFF)
    assert raw.status[1] == 5
    raw.wait(5.0)
    assert raw.status == (GOING | 0xC0, 0, 100, 100)


def test_a_command_without_activation_is_a_fault_and_moves_nothing(raw: Hand) -> None:
    raw.tell(0x0800, 255, 0xFFFF, s=2.0)
    assert (raw.status[1], raw.status[3]) == (7, 3)
    assert "motion_started" not in raw.did


def test_until_its_next_cycle_it_reports_the_old_state(hand: Hand) -> None:
    hand.tell(0x0900, 100, 0xFFFF, s=5.0)
    hand.tell(0x0900, 200, 0xFFFF, s=CYCLE_S / 2)
    assert hand.status == (GOING | 0xC0, 0, 100, 100)
    hand.wait(CYCLE_S)
    assert hand.status[:3] == (GOING, 0, 200)


def test_it_moves_to_the_commanded_position_at_the_commanded_speed(hand: Hand) -> None:
    times: list[float] = []
    for how, goal in ((0x00FF, 200), (0xFFFF, 20)):
        hand.tell(0x0900, goal, how)
        began = hand.clock.now
        while hand.contact == 0:
            hand.wait(0.001)
        times.append(hand.clock.now - began)
        assert hand.status[3] == goal
    assert times[0] / times[1] == pytest.approx(7.5 * 197 / 180, rel=0.05)


def test_the_ends_of_the_range_are_reached_though_the_stops_come_before_them(hand: Hand) -> None:
    hand.tell(0x0900, 255, 0xFFFF, s=5.0)
    assert hand.status == (GOING | 0xC0, 0, 255, 230)
    hand.tell(0x0900, 0, 0xFFFF, s=5.0)
    assert hand.status == (GOING | 0xC0, 0, 0, 3)


def test_an_object_stops_the_fingers_and_more_force_presses_it_further(hand: Hand) -> None:
    hand.gripper.put(Object(0.04, 20_000, inside=False), hand.clock.now)
    depths: list[int] = []
    for how in (0xFF00, 0xFFFF):
        hand.tell(0x0900, 255, how, s=5.0)
        assert hand.contact == 2
        depths.append(hand.status[3])
    surface = 230 - 0.04 * 227 / 0.085
    pressed = [(depth - surface) * 0.085 / 227 * 20_000 for depth in depths]
    assert pressed == pytest.approx([20, 235], abs=0.6 * 20_000 * 0.085 / 227)


def test_a_hollow_object_is_met_from_inside(hand: Hand) -> None:
    hand.tell(0x0900, 255, 0xFFFF, s=5.0)
    hand.gripper.put(Object(0.05, 20_000, inside=True), hand.clock.now)
    hand.tell(0x0900, 0, 0xFFFF, s=5.0)
    assert hand.contact == 1
    assert hand.gripper.state(hand.clock.now).holding


def test_an_object_that_goes_lets_the_fingers_close(hand: Hand) -> None:
    hand.gripper.put(Object(0.04, 20_000, inside=False), hand.clock.now)
    hand.tell(0x0900, 255, 0xFFFF, s=5.0)
    hand.gripper.put(None, hand.clock.now)
    assert hand.contact == 0
    hand.wait(5.0)
    assert (hand.contact, hand.status[3]) == (3, 230)


def test_without_go_the_fingers_rest(hand: Hand) -> None:
    hand.tell(0x0900, 255, 0x00FF, s=0.5)
    hand.tell(0x0100, 255, 0x00FF)
    stood = hand.status[3]
    hand.wait(5.0)
    assert hand.status == (ACTIVE, 0, 255, stood)
    assert hand.did == ["motion_started", "at_rest"]


def test_taking_activation_away_ends_activation_and_motion(raw: Hand) -> None:
    raw.tell(0x0100, 0, 0, s=0.3)
    raw.tell(0, 0, 0)
    stood = raw.status
    raw.wait(5.0)
    assert raw.status == stood
    assert 3 < stood[3] < 230
    assert stood[0] == 0


def test_a_major_fault_stops_it_until_it_is_activated_again(hand: Hand) -> None:
    hand.tell(0x0900, 255, 0x00FF, s=0.5)
    hand.gripper.fail(0x0E, hand.clock.now)
    stood = hand.status[3]
    hand.tell(0x0900, 0, 0xFFFF, s=5.0)
    hand.gripper.heal(hand.clock.now)
    assert (hand.status[1], hand.status[3]) == (0x0E, stood)
    hand.tell(0, 0, 0)
    assert hand.status[:2] == (0, 0)
    hand.tell(0x0100, 0, 0, s=5.0)
    assert hand.status[0] == ACTIVE


def test_heat_is_a_fault_until_it_has_cooled_down_and_nothing_is_resumed(hand: Hand) -> None:
    hand.tell(0x0900, 255, 0)
    hand.gripper.set_supply(hand.clock.now, temperature_c=85)
    stood = hand.status[3]
    for celsius, fault in ((80, 0x08), (79, 0)):
        hand.gripper.set_supply(hand.clock.now, temperature_c=celsius)
        hand.wait(1.0)
        assert hand.status[1:] == (fault, 255, stood)


def test_a_low_supply_is_a_fault_that_a_reset_does_not_end(hand: Hand) -> None:
    hand.gripper.set_supply(hand.clock.now, voltage_v=21.0)
    hand.tell(0, 0, 0)
    assert hand.status[1] == 0x0A
    hand.gripper.set_supply(hand.clock.now, voltage_v=24.0)
    assert hand.status[1] == 0x0A
    hand.tell(0x0100, 0, 0)
    hand.tell(0, 0, 0)
    assert hand.status[1] == 0


def test_a_brown_out_loses_registers_and_activation(hand: Hand) -> None:
    hand.tell(0x0900, 255, 0x00FF, s=0.5)
    hand.gripper.brown_out(hand.clock.now)
    stood = hand.status[3]
    hand.wait(5.0)
    assert hand.status == (0, 0, 0, stood)
    assert hand.gripper.command == (0, 0, 0)


def test_a_second_of_silence_is_reported_in_the_next_answer_only(hand: Hand) -> None:
    hand.gripper.heard(hand.clock.now)
    hand.wait(1.5)
    hand.gripper.heard(hand.clock.now)
    assert hand.status[1] == 9
    hand.wait(2 * CYCLE_S)
    assert hand.status[1] == 0


def test_a_frozen_sensor_shows_one_position_while_the_fingers_move(hand: Hand) -> None:
    hand.gripper.freeze(True, hand.clock.now)
    hand.tell(0x0900, 255, 0xFFFF, s=5.0)
    assert hand.status[3] == 3
    assert hand.gripper.state(hand.clock.now).position_counts == 230


def test_registers_that_are_not_there_are_neither_read_nor_written(hand: Hand) -> None:
    now = hand.clock.now
    assert hand.gripper.read(STATUS, 8, now) is not None
    assert hand.gripper.read(STATUS, 9, now) is None
    assert hand.gripper.read(STATUS, 0, now) is None
    assert not hand.gripper.write(STATUS, (1,), now)
    assert not hand.gripper.write(COMMAND + 7, (1, 2), now)
    assert hand.gripper.read(COMMAND, 3, now) == (0x0100, 0, 0)
