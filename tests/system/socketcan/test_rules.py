"""The rules of motion on an interface of the system, judged on candump's record: the very same tests as elsewhere."""

# ruff: noqa: F401 - what is imported here is run here

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.contract.conftest import gate
from tests.contract.rigs.can_joints import Cia402Rig
from tests.contract.test_safety import (
    test_S01_a_move_of_an_enabled_joint_that_expires_meanwhile_is_never_written,
    test_S06_a_driver_process_that_dies_or_freezes_while_moving_is_stopped_by_the_device,
    test_S06_a_driver_that_wakes_up_moves_nothing_and_says_why,
    test_S06_an_unhealthy_process_holds_once_and_falls_silent,
    test_S06_every_enabled_joint_has_its_watchdog_armed,
    test_S07_a_stop_gets_through_while_another_joint_is_silent,
    test_S08_a_command_admitted_before_a_stop_is_dropped_after_it,
    test_S11_a_command_whose_lock_is_gone_is_kept_off_the_wire,
    test_S18_attaching_commands_nothing,
    test_S19_shutdown_holds_the_position_disarms_the_watchdog_and_moves_nothing,
    test_S19_shutdown_while_moving_stops_first,
)
from tests.system.socketcan.candump import RecordedLeg
from tests.unit.drivers.legs import PATIENT, Leg
from tests.unit.drivers.test_cia402_attach import test_S20_a_bus_that_has_a_driver_is_not_taken_by_a_second
from tests.unit.drivers.test_cia402_motor import (
    test_a_set_point_has_an_edge_and_the_edge_is_taken_back_when_it_was_taken,
    test_enabling_passes_one_state_after_the_other_and_ends_halted_at_the_current_position,
)
from tests.unit.drivers.test_cia402_safety import test_S18_a_moving_drive_without_an_owner_is_stopped_and_left_enabled


@pytest.fixture
def bench(recorded: RecordedLeg, request: pytest.FixtureRequest) -> RecordedLeg:
    if not request.node.name.startswith(("test_S06", "test_S19")):  # those are about the watchdog as it is
        recorded.configure(PATIENT)
    return recorded


@pytest.fixture
def leg(bench: RecordedLeg) -> Leg:
    bench.plug()
    return bench


@pytest.fixture
def rig(bench: RecordedLeg, tmp_path: Path) -> Iterator[Cia402Rig]:
    class OnTheInterface(Cia402Rig):
        def on_the_bench(self) -> RecordedLeg:
            return bench

    with ExitStack() as undo:
        yield OnTheInterface(undo, tmp_path)
