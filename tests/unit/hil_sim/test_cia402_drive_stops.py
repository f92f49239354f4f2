"""How the simulated drive stops, and what becomes of it when something is done to it, judged by shaft and log."""

from typing import Any

import pytest

from tests.unit.hil_sim.drive_bench import (
    ENABLE,
    QUICK_STOP,
    RESET,
    SHUTDOWN,
    STATUS,
    SWITCH_ON,
    Bench,
    enabled,
    move,
)
from trade_hil_sim import (
    BrownOut,
    BusOff,
    Emergency,
    Freeze,
    HardwareFault,
    Jam,
    Place,
    SimulationError,
    Supply,
    WrongModel,
)
from trade_hil_sim.cia402 import Mode, State

pytestmark = pytest.mark.virtual_time

SOD, RTSO, SO = State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.SWITCHED_ON
OE = State.OPERATION_ENABLED

# stops


@pytest.mark.parametrize(
    ("option", "after", "ratio"),
    [(1, SOD, 1), (2, SOD, 10), (5, State.QUICK_STOP_ACTIVE, 1), (6, State.QUICK_STOP_ACTIVE, 10)],
)
def test_a_quick_stop_ramps_and_then_does_as_its_option_says(option: int, after: State, ratio: int) -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.put(0x605A, option, 2)
    bench.put(0x60FF, 20_000, 4)
    bench.run(0.5)
    bench.put(0x6084, 50_000, 4)
    bench.put(0x6085, 500_000, 4)
    assert bench.control(QUICK_STOP) & STATUS == State.QUICK_STOP_ACTIVE
    took = bench.until(lambda: bench.velocity == 0, within_s=1)
    assert took == pytest.approx(0.4 / ratio, abs=0.003)
    bench.run(0.01)
    assert bench.state is after
    bench.control(ENABLE)
    assert bench.state is (OE if after is State.QUICK_STOP_ACTIVE else SOD)


@pytest.mark.parametrize(("word", "index", "after"), [(SWITCH_ON, 0x605C, SO), (SHUTDOWN, 0x605B, RTSO)])
@pytest.mark.parametrize("option", [0, 1])
def test_operation_is_left_with_or_without_a_ramp(word: int, index: int, after: State, option: int) -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.put(index, option, 2)
    bench.put(0x60FF, 20_000, 4)
    bench.run(0.5)
    bench.control(word)
    assert bench.state is (OE if option else after)
    bench.run(0.2)
    assert (bench.state, bench.velocity) == (after, 0)


def test_a_ramp_to_leave_operation_can_be_called_off() -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.put(0x60FF, 20_000, 4)
    bench.run(0.5)
    bench.control(SWITCH_ON)
    bench.run(0.01)
    bench.control(ENABLE)
    bench.run(0.5)
    assert (bench.state, bench.velocity) == (OE, 20_000)


@pytest.mark.parametrize(
    ("option", "state", "moves"),
    [(0, OE, True), (1, State.FAULT, False), (2, SOD, False), (3, SOD, False)],
)
@pytest.mark.parametrize("mode", [Mode.PROFILE_VELOCITY, Mode.CYCLIC_VELOCITY])
def test_S06_a_drive_whose_master_is_silent_stops_by_itself(mode: Mode, option: int, state: State, moves: bool) -> None:
    bench = enabled(mode)
    bench.put(0x6007, option, 2)
    bench.put(0x1016, 127 << 16 | 100, 4, 1)
    bench.put(0x60FF, 20_000, 4)
    for _ in range(10):
        bench.hear(0x77F, "05")
        bench.run(0.09)
    assert bench.velocity == 20_000
    bench.run(0.3)
    assert (bench.state, bench.velocity != 0) == (state, moves)
    assert "watchdog_expired" in bench.names()
    bench.hear(0x77F, "05")
    bench.run(1.0)
    assert (bench.state, bench.velocity != 0) == (state, moves)  # nothing moves because it is back


def test_a_silent_master_is_no_fault_of_a_drive_without_power(bench: Bench) -> None:
    bench.put(0x1016, 127 << 16 | 100, 4, 1)
    bench.hear(0x77F, "05")
    bench.run(1.0)
    assert bench.state is SOD


def test_being_stopped_by_network_management_is_losing_the_master() -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.put(0x60FF, 20_000, 4)
    bench.run(0.5)
    bench.hear(0, "0205")
    bench.run(0.5)
    assert bench.state is State.FAULT


# faults: what is done to it, the error code it shows, the bits of 1001h

FAULTS: list[Any] = [
    pytest.param(Emergency(code=0x2310), 0x2310, 0b11, id="over-current"),
    pytest.param(Emergency(code=0x7305), 0x7305, 0b1000_0001, id="encoder"),
    pytest.param(Supply(voltage_v=5.0), 0x3220, 0b101, id="under-voltage"),
    pytest.param(Supply(voltage_v=90.0), 0x3210, 0b101, id="over-voltage"),
    pytest.param(Supply(temperature_c=120), 0x4310, 0b1001, id="over-temperature"),
    pytest.param(Jam(), 0x8611, 0b10_0001, id="jam"),
    pytest.param(Place(counts=500_000), 0x8611, 0b10_0001, id="forced away"),
]


@pytest.mark.parametrize(("fault", "code", "register"), FAULTS)
def test_a_fault_stops_the_drive_is_reported_and_stays_until_reset(fault: Any, code: int, register: int) -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.hear(0, "0105")
    bench.put(0x60FF, 20_000, 4)
    bench.run(0.5)
    bench.sent.clear()
    bench.drive.do(fault, bench.t)
    bench.run(1.0)
    assert (bench.state, bench.get(0x603F), bench.get(0x1001), bench.velocity) == (State.FAULT, code, register, 0)
    assert bench.frames(0x085) == [f"{code & 0xFF:02x}{code >> 8:02x}{register:02x}0000000000"]
    shown = [int.from_bytes(bytes.fromhex(f), "little") & 0x4F for f in bench.frames(0x185)]
    assert shown[-2:] == [0x0F, 0x08]
    for word in (SHUTDOWN, SWITCH_ON, ENABLE):
        bench.control(word)
        assert bench.state is State.FAULT
    bench.drive.heal(bench.t)
    bench.run(0.1)
    assert bench.state is State.FAULT
    bench.control(RESET)
    assert (bench.state, bench.get(0x603F), bench.get(0x1001)) == (SOD, 0, 0)
    assert bench.frames(0x085)[1:] == ["0000000000000000"]
    bench.run(1.0)
    assert bench.velocity == 0


def test_a_fault_whose_cause_lasts_cannot_be_reset_and_only_an_edge_resets(bench: Bench) -> None:
    bench.drive.do(Emergency(code=0x4210, lasting=True), bench.t)
    bench.control(RESET)
    assert bench.state is State.FAULT
    assert "refused" in bench.names()
    bench.drive.heal(bench.t)
    bench.control(RESET)
    assert bench.state is State.FAULT  # the bit was up already
    bench.control(0)
    bench.control(RESET)
    assert bench.state is SOD


@pytest.mark.parametrize(("option", "ratio"), [(1, 1), (2, 10)])
def test_a_fault_reaction_ramps_as_its_option_says(option: int, ratio: int) -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.put(0x605E, option, 2)
    bench.put(0x60FF, 20_000, 4)
    bench.run(0.5)
    bench.put(0x6084, 50_000, 4)
    bench.put(0x6085, 500_000, 4)
    bench.drive.do(Emergency(code=0x2310), bench.t)
    assert bench.state is State.FAULT_REACTION_ACTIVE
    assert bench.until(lambda: bench.state is State.FAULT, within_s=1) == pytest.approx(0.4 / ratio, abs=0.003)


def test_a_held_shaft_shows_full_torque_and_continues_when_released() -> None:
    bench = enabled(Mode.CYCLIC_VELOCITY)
    bench.put(0x6065, 1_000_000, 4)
    bench.put(0x60FF, 5000, 4)
    bench.run(0.2)
    bench.drive.do(Jam(), bench.t)
    bench.run(0.2)
    held = bench.position
    assert (bench.velocity, bench.get(0x6077), bench.get(0x60F4)) == (0, 1000, 1000)
    bench.drive.do(Jam(on=False), bench.t)
    bench.run(0.2)
    assert bench.position > held
    assert bench.velocity == 5000


def test_a_frozen_sensor_shows_the_same_while_the_shaft_turns() -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.put(0x60FF, 5000, 4)
    bench.run(0.5)
    bench.drive.do(Freeze(), bench.t)
    shown = (bench.position, bench.velocity)
    truth = bench.drive.state(bench.t).position_counts
    bench.run(0.5)
    assert (bench.position, bench.velocity) == shown
    assert bench.drive.state(bench.t).position_counts > truth
    bench.drive.do(Freeze(on=False), bench.t)
    assert bench.position > shown[0]


def test_losing_power_clears_all_registers_and_keeps_the_shaft_position() -> None:
    bench = enabled(Mode.PROFILE_POSITION)
    move(bench, 3000)
    bench.run(2.0)
    bench.drive.do(BrownOut(), bench.t)
    bench.run(0.1)
    assert (bench.state, bench.get(0x6061), bench.position, bench.get(0x607A)) == (SOD, 0, 3000, 0)
    assert bench.frames(0x705) == ["00", "00"]
    assert {"brown_out", "torque_off", "booted"} <= set(bench.names()[-6:])


def test_a_swap_shows_in_its_identity_and_what_it_has_not_got_is_refused(bench: Bench) -> None:
    assert bench.get(0x1018, 2) == 402
    bench.drive.do(WrongModel(number=77), bench.t)
    assert bench.get(0x1018, 2) == 77
    with pytest.raises(SimulationError, match="HardwareFault is nothing that happens to a CiA 402 drive"):
        bench.drive.do(HardwareFault(), bench.t)


def test_a_drive_that_goes_bus_off_stops() -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    bench.put(0x60FF, 20_000, 4)
    bench.run(0.5)
    bench.drive.do(BusOff(), bench.t)
    bench.run(0.5)
    assert bench.drive.state(bench.t).velocity_rad_s == 0


def test_a_shaft_turned_by_hand_goes_back_only_if_it_is_driven(bench: Bench) -> None:
    bench.drive.do(Place(counts=500), bench.t)
    bench.run(1.0)
    assert bench.position == 500
    bench.enable(Mode.PROFILE_POSITION)
    bench.drive.do(Place(counts=700), bench.t)
    bench.run(1.0)
    assert bench.position == 500
