"""Complaints of other projects about answers: bad ones, missing ones, old ones, and those of the wrong device."""

import time
from pathlib import Path

import pytest

from tests.contract.complaints import wire_mutants as mutants
from tests.contract.complaints.bodies import Body, Call, outcome
from tests.contract.complaints.table import complaint
from tests.support.simulated_robots import HEAD, TAIL
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import sleep_past
from tests.unit.drivers.test_second_reader import HOLDS, other_program
from trade_drivers import check, parse
from trade_hil_sim import Unplug

pytestmark = pytest.mark.realtime


@complaint(
    ("dynamixel", mutants.a_read_that_fails_ends_the_loop, "thread of its bus failed"),
    ("feetech", mutants.a_read_that_fails_ends_the_loop, "thread of its bus failed"),
    ("cia402", mutants.a_drives_frame_is_unpacked_unseen, "thread of its bus failed"),
    ("damiao", mutants.a_motors_frame_is_unpacked_unseen, "thread of its bus failed"),
)
def test_a_bad_packet_kills_the_loop(body: Body) -> None:
    motor = body.motor()
    assert outcome(motor.enable) == ""
    body.strike(body.ways.bad_packet)
    assert outcome(lambda: motor.move_to(0.4)) == ""
    assert abs(body.truth.position_rad - 0.4) < 0.03
    assert motor.state().fault == ""


@complaint(
    ("dynamixel", mutants.the_bare_dynamixel_sdk_takes_any_device_that_obeys, "was taken for the joint"),
    ("feetech", mutants.no_driver_compares_the_model, "was taken for the joint"),
    ("cia402", mutants.no_driver_compares_the_serial_number, "was taken for the joint"),
)
def test_wrong_or_duplicate_ids(body: Body) -> None:
    body.ways.confuse(body.rig)
    refusal = outcome(body.attach)
    assert refusal.startswith(("ConfigurationError", "WrongDevice")), f"another was taken for the joint {refusal}"
    assert not body.moves()


@complaint(
    ("dynamixel", mutants.a_dynamixel_that_is_silent_reads_zero, "-3.14 rad, where the joint never was"),
    ("dynamixel", mutants.the_bare_dynamixel_sdk, "-3.14 rad, where the joint never was"),
    ("feetech", mutants.a_feetech_that_is_silent_reads_zero, "-3.14 rad, where the joint never was"),
    ("cia402", mutants.a_write_is_done_when_it_is_sent, "went unanswered and ended with success"),
)
def test_an_empty_reply_taken_for_success(body: Body) -> None:
    body.turn_by_hand(0.5)
    motor = body.motor()
    body.strike(body.ways.deaf)
    enabling = Call(motor.enable)

    def ended() -> bool:
        reported: list[float] = []
        outcome(lambda: reported.append(motor.state().position_rad))
        assert all(abs(angle - 0.5) < 0.01 for angle in reported), f"{reported[0]:.2f} rad, where the joint never was"
        return enabling.ended is not None

    wait_until(ended, "enable() has ended")
    assert enabling.ended, "enable() went unanswered and ended with success"
    assert enabling.ended.startswith("DeviceSilent")


@complaint(
    ("dynamixel", mutants.the_last_value_is_reported_without_end, "an old state is reported as the current one"),
    ("cia402", mutants.the_last_value_is_reported_without_end, "an old state is reported as the current one"),
    also=("feetech", "damiao"),
)
def test_stale_state_after_link_loss(body: Body) -> None:
    motor = body.motor()
    assert outcome(motor.state) == ""
    body.strike(Unplug())
    wait_until(lambda: "BusGone" in outcome(motor.relax), "its driver has noticed")
    sleep_past(time.monotonic_ns() + int(body.rig.robot.buses[0].stale_after_s * 1e9))
    assert outcome(motor.state).startswith("BusGone"), "an old state is reported as the current one"


@complaint(("feetech", mutants.a_missing_answer_is_the_devices, "its error names the program"))
def test_another_program_takes_the_answers(body: Body) -> None:
    motor = body.motor()
    with other_program(str(body.rig.sim.port), HOLDS) as pid:
        body.strike(body.ways.deaf)
        wait_until(lambda: f"(pid {pid})" in outcome(motor.state), "its error names the program")


@complaint(("folder", mutants.two_names_are_two_ports, "was accepted"))
def test_one_adapter_has_two_names_in_a_file(folder: Path) -> None:
    link = folder / "by-id"
    link.symlink_to("/dev/null")
    text = HEAD.replace("/dev/ttyNOWHERE", "/dev/null") + TAIL.partition('"rosie"')[2]
    refusal = outcome(lambda: check(parse(text.replace("/dev/ttyNOTAIL", str(link)), "rosie.toml")))
    assert refusal, "the file was accepted"
    assert "bus.neck.port" in refusal
    assert "bus.tail.port" in refusal
