"""The drive side of the simulated drive: states and modes of CiA 402-2, judged by shaft and log."""

from itertools import pairwise

import pytest
from canopen.profiles.p402 import OperationMode, State402

from tests.unit.hil_sim.drive_bench import (
    ACK,
    AT_ONCE,
    DISABLE_VOLTAGE,
    ENABLE,
    HALT,
    LIMITED,
    NEW,
    QUICK_STOP,
    REACHED,
    RELATIVE,
    RESET,
    SHUTDOWN,
    STATUS,
    SWITCH_ON,
    Bench,
    enabled,
    move,
)
from trade_hil_sim.cia402 import Command, Mode, State, command, next_state

pytestmark = pytest.mark.virtual_time

# states

PATHS = {
    State.SWITCH_ON_DISABLED: [],
    State.READY_TO_SWITCH_ON: [SHUTDOWN],
    State.SWITCHED_ON: [SHUTDOWN, SWITCH_ON],
    State.OPERATION_ENABLED: [SHUTDOWN, SWITCH_ON, ENABLE],
}
SOD, RTSO, SO, OE = PATHS
TRANSITIONS = [
    (SOD, SWITCH_ON, SOD),
    (SOD, ENABLE, SOD),
    (SOD, QUICK_STOP, SOD),
    (SOD, SHUTDOWN, RTSO),
    (RTSO, SWITCH_ON, SO),
    (RTSO, ENABLE, OE),
    (RTSO, QUICK_STOP, SOD),
    (RTSO, DISABLE_VOLTAGE, SOD),
    (SO, SHUTDOWN, RTSO),
    (SO, ENABLE, OE),
    (SO, QUICK_STOP, SOD),
    (SO, DISABLE_VOLTAGE, SOD),
    (OE, SWITCH_ON, SO),
    (OE, SHUTDOWN, RTSO),
    (OE, QUICK_STOP, SOD),
    (OE, DISABLE_VOLTAGE, SOD),
    (OE, RESET, SOD),
]


@pytest.mark.parametrize(("before", "word", "after"), TRANSITIONS)
def test_a_command_leads_where_the_standard_says(bench: Bench, before: State, word: int, after: State) -> None:
    for step in PATHS[before]:
        bench.control(step)
    assert bench.state is before
    assert bench.status & STATUS & ~0x20 == before & ~0x20
    bench.control(word)
    bench.run(0.001)
    assert bench.state is after
    mask = 0x4F if after is SOD else 0x6F
    assert bench.status & mask == after


def test_the_table_of_commands_is_total() -> None:
    assert {command(word) for word in range(256)} == set(Command)
    for state in State:
        for wanted in Command:
            assert next_state(state, wanted) in State


def test_torque_is_on_while_operation_is_enabled(bench: Bench) -> None:
    bench.enable(Mode.PROFILE_POSITION)
    assert bench.drive.state(bench.t).torque
    bench.control(SWITCH_ON)
    assert not bench.drive.state(bench.t).torque
    assert [name for name in bench.names() if name.startswith("torque")] == ["torque_on", "torque_off"]


def test_the_displayed_mode_changes_only_once_the_mode_has_changed(bench: Bench) -> None:
    bench.put(0x6060, Mode.PROFILE_VELOCITY, 1)
    assert bench.get(0x6061) == 0
    bench.run(0.01)
    assert bench.get(0x6061) == 3
    assert bench.get(0x6502) == 0b11_1010_1101
    assert bench.try_put(0x6060, 2, 1) == 0x0609_0030


# profile position


def test_a_move_ends_at_its_target_within_speed_and_acceleration() -> None:
    bench = enabled(Mode.PROFILE_POSITION)
    bench.put(0x6081, 10_000, 4)
    bench.put(0x6083, 50_000, 4)
    move(bench, 8000)
    speeds, word = [0], 0
    while not word & REACHED:
        bench.run(0.01)
        speeds.append(bench.velocity)
        word = bench.status
        assert len(speeds) < 200
    assert bench.position == 8000
    assert max(speeds) == 10_000
    assert max(b - a for a, b in pairwise(speeds)) <= 500 + 1
    assert bench.names()[-2:] == ["motion_started", "at_rest"]


def test_a_target_alone_moves_nothing_and_an_edge_counts_once() -> None:
    bench = enabled(Mode.PROFILE_POSITION)
    bench.put(0x607A, 5000, 4)
    bench.run(0.5)
    assert bench.position == 0
    bench.control(ENABLE | NEW)
    bench.put(0x607A, -5000, 4)
    assert bench.control(ENABLE | NEW) & ACK
    bench.run(5.0)
    assert bench.position == 5000
    assert bench.status & (REACHED | ACK) == REACHED | ACK  # it waits for bit 4 to fall
    assert not bench.control(ENABLE) & ACK


def test_a_second_set_point_waits_for_the_first_and_a_third_is_not_taken() -> None:
    bench = enabled(Mode.PROFILE_POSITION)
    move(bench, 20_000)
    bench.run(0.1)
    bench.put(0x607A, 0, 4)
    assert bench.control(ENABLE | NEW) & ACK
    assert bench.control(ENABLE) & ACK  # the buffer is full
    bench.put(0x607A, 777, 4)
    bench.control(ENABLE | NEW)
    bench.control(ENABLE)
    bench.until(lambda: bench.position == 20_000, within_s=5)
    bench.run(0.01)
    assert not bench.status & ACK
    bench.run(5.0)
    assert (bench.position, bool(bench.status & REACHED)) == (0, True)


def test_a_set_point_may_take_over_at_once_or_be_relative() -> None:
    bench = enabled(Mode.PROFILE_POSITION, position=1000)
    move(bench, 50_000)
    bench.run(0.2)
    move(bench, 0, AT_ONCE)
    bench.run(5.0)
    assert bench.position == 0
    move(bench, 300, RELATIVE)
    bench.run(1.0)
    move(bench, 300, RELATIVE)
    bench.run(1.0)
    assert bench.position == 600


def test_halt_stops_and_motion_continues_at_its_end() -> None:
    bench = enabled(Mode.PROFILE_POSITION)
    move(bench, 20_000)
    bench.run(0.3)
    bench.control(ENABLE | HALT)
    bench.until(lambda: bench.velocity == 0, within_s=1)
    stopped_at = bench.position
    assert bench.status & REACHED
    bench.control(ENABLE | HALT | NEW)  # no set-point while halted
    bench.run(1.0)
    assert bench.position == stopped_at < 20_000
    bench.control(ENABLE)
    bench.run(5.0)
    assert bench.position == 20_000


def test_targets_are_held_within_the_position_limits_and_bit_11_says_so() -> None:
    bench = enabled(Mode.PROFILE_POSITION)
    bench.put(0x607D, 1000, 4, 2)
    assert bench.try_put(0x607D, 1001, 4, 1) == 0x0609_0030
    move(bench, 5000)
    assert bench.status & LIMITED
    bench.run(2.0)
    assert bench.position == 1000
    move(bench, 500)
    assert not bench.status & LIMITED


# velocity and torque


@pytest.mark.parametrize("mode", [Mode.PROFILE_VELOCITY, Mode.CYCLIC_VELOCITY])
def test_a_velocity_is_kept_until_another_is_written(mode: Mode) -> None:
    bench = enabled(mode)
    bench.put(0x60FF, -5000, 4)
    bench.run(0.5)
    assert bench.velocity == -5000
    assert -2500 <= bench.position < -2000
    bench.put(0x60FF, 0, 4)
    bench.until(lambda: bench.velocity == 0, within_s=1)
    if mode is Mode.PROFILE_VELOCITY:
        assert bench.status & ACK  # bit 12 is speed zero here
        assert bench.status & REACHED


def test_a_velocity_ends_at_the_position_limit() -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.put(0x607D, -100, 4, 1)
    bench.put(0x607D, 3000, 4, 2)
    bench.put(0x60FF, 10_000, 4)
    bench.run(3.0)
    assert (bench.position, bench.velocity) == (3000, 0)


def test_a_torque_turns_the_shaft_and_its_sign_the_other_way() -> None:
    bench = enabled(Mode.PROFILE_TORQUE)
    bench.put(0x6071, 10, 2)
    bench.run(0.1)
    assert bench.velocity > 0
    assert bench.get(0x6077, signed=True) == 10
    bench.put(0x6071, -10, 2)
    bench.run(1.0)
    assert bench.velocity < 0
    assert bench.try_put(0x6071, 1001, 2) == 0x0609_0030


# cyclic position


def test_set_points_of_a_train_are_reached_one_period_later() -> None:
    bench = enabled(Mode.CYCLIC_POSITION)
    bench.put(0x60C2, 2, 1, 1)  # 2 ms
    for k in range(1, 51):
        bench.put(0x607A, k * 20, 4)
        bench.run(0.002)
        assert bench.position == k * 20
    assert bench.status & ACK  # bit 12: follows


def test_a_jump_is_limited_and_too_large_a_one_is_a_following_error() -> None:
    bench = enabled(Mode.CYCLIC_POSITION)
    bench.put(0x607F, 50_000, 4)
    bench.put(0x607A, 1500, 4)
    bench.run(0.01)
    assert 0 < bench.position <= 500
    assert bench.get(0x60F4, signed=True) == 1500 - bench.position
    bench.run(0.5)
    assert (bench.position, bench.velocity, bench.state) == (1500, 0, State.OPERATION_ENABLED)
    bench.put(0x607A, 100_000, 4)
    bench.run(0.2)
    assert (bench.state, bench.get(0x603F)) == (State.FAULT, 0x8611)


@pytest.mark.parametrize(("mode", "halts"), [(Mode.PROFILE_VELOCITY, True), (Mode.CYCLIC_VELOCITY, False)])
def test_a_cyclic_mode_knows_no_halt(mode: Mode, halts: bool) -> None:
    bench = enabled(mode)
    bench.put(0x60FF, 20_000, 4)
    bench.run(0.5)
    bench.control(ENABLE | HALT)
    bench.run(0.5)
    assert (bench.velocity == 0) == halts


def test_a_stale_target_is_followed_as_soon_as_operation_is_enabled() -> None:
    bench = Bench(position_counts=1500)  # the trap: the target is still 0
    bench.enable(Mode.CYCLIC_POSITION)
    bench.run(0.5)
    assert bench.position == 0
    assert "motion_started" in bench.names()


# homing


@pytest.mark.parametrize(
    ("method", "start", "turned"),
    [(35, 1234, 0), (37, 1234, 0), (33, 1234, -1234), (34, 1234, 2862), (17, 0, -200_000)],
)
def test_homing_finds_its_place_and_calls_it_zero(method: int, start: int, turned: int) -> None:
    bench = enabled(Mode.HOMING, position=start)
    bench.put(0x6099, 100_000, 4, 1)
    bench.put(0x6099, 100_000, 4, 2)
    bench.put(0x6098, method, 1)
    before = bench.drive.state(bench.t).position_rad
    assert bench.status & 0x3400 == 0x0400
    word = bench.control(ENABLE | NEW)
    assert word & 0x3400 == (0x1400 if turned == 0 else 0)
    bench.until(lambda: bench.status & 0x3400 == 0x1400, within_s=30)
    assert bench.position == 0
    after = bench.drive.state(bench.t).position_rad
    assert (after - before) / 6.283185307 * 4096 == pytest.approx(turned, abs=0.01)


def test_homing_is_interrupted_by_taking_bit_4_away_and_an_unknown_method_is_an_error() -> None:
    bench = enabled(Mode.HOMING)
    bench.put(0x6098, 17, 1)
    bench.control(ENABLE | NEW)
    bench.run(0.5)
    assert bench.velocity < 0
    assert bench.control(ENABLE) & 0x3400 == 0x0400
    bench.run(1.0)
    assert bench.velocity == 0
    bench.put(0x6098, 7, 1)
    assert bench.control(ENABLE | NEW) & 0x3400 == 0x2400


# the same facts, written by others


def test_states_commands_and_modes_are_those_of_the_library_canopen() -> None:
    for state in State:
        mask, bits = State402.SW_MASK[state.name.replace("_", " ")]
        assert state & mask == bits
    assert {name: command(word).name for name, word in State402.CW_COMMANDS_CODE.items()} == {
        "SWITCH ON DISABLED": "DISABLE_VOLTAGE",  # they mean the fault reset
        "DISABLE VOLTAGE": "DISABLE_VOLTAGE",
        "READY TO SWITCH ON": "SHUTDOWN",
        "SWITCHED ON": "SWITCH_ON",
        "OPERATION ENABLED": "ENABLE_OPERATION",
        "QUICK STOP ACTIVE": "QUICK_STOP",
    }
    ours = {mode.name.replace("PROFILE_", "PROFILED_").replace("CYCLIC", "CYCLIC SYNCHRONOUS") for mode in Mode if mode}
    theirs = {name.replace("_", " "): OperationMode.NAME2CODE[name.replace("_", " ")] for name in ours}
    assert sorted(theirs.values()) == sorted(mode for mode in Mode if mode)
    supported = sum(OperationMode.SUPPORTED[name] for name in theirs)
    assert Bench().get(0x6502) == supported
