"""Complaints of other projects about how motion begins and ends, and what comes after a fault."""

import pytest

from tests.contract.complaints import motion_mutants as mutants
from tests.contract.complaints.bodies import Body, Call, outcome
from tests.contract.complaints.table import complaint
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from trade import where
from trade.testing import memory_system
from trade_hil_sim import BrownOut, Heal, Replug, Unplug

pytestmark = pytest.mark.realtime


@complaint(
    ("dynamixel", mutants.a_driver_that_leaves_relaxes, "it has let go"),
    ("cia402", mutants.a_driver_that_leaves_relaxes, "it has let go"),
    also=("feetech", "damiao"),
)
def test_torque_drops_at_exit(body: Body) -> None:
    robot = body.attach()
    robot.motor(body.ways.joint).move_to(0.3)
    robot.close()
    assert body.truth.torque, "it has let go"
    assert abs(body.truth.position_rad - 0.3) < 0.03


@complaint(
    ("dynamixel", mutants.enabling_wants_no_fault, "enable.. ended with DeviceFault.*overload"),
    ("dynamixel", mutants.enabling_restarts_no_servo, "enable.. ended with DeviceFault.*overload"),
    ("feetech", mutants.enabling_wants_no_fault, "enable.. ended with DeviceFault.*overload"),
    ("damiao", mutants.enabling_wants_no_fault, "enable.. ended with DeviceFault.*overload"),
    ("cia402", mutants.enabling_wants_no_fault, "enable.. ended with DeviceFault.*over-current"),
    ("cia402", mutants.enabling_resets_no_fault_of_a_drive, "enable.. ended with DeviceFault.*over-current"),
)
def test_overload_latched_until_a_power_cycle(body: Body) -> None:
    motor = body.motor()
    motor.move_to(0.2)
    body.strike(body.ways.overload)
    wait_until(lambda: motor.state().fault, "state() reports it")
    assert outcome(lambda: motor.move_to(0.1)).startswith("DeviceFault")
    body.strike(Heal())
    reported = outcome(motor.enable)
    assert not reported, f"enable() ended with {reported}"
    assert abs(motor.move_to(0.0)) < 0.03


@complaint(
    ("feetech", mutants.the_last_speed_holds_without_end, "it continued"),
    ("cia402", mutants.the_last_speed_holds_without_end, "it continued"),
    also=("dynamixel", "damiao"),
)
def test_client_dies_and_the_robot_moves_on_at_its_last_speed(body: Body) -> None:
    motor = body.motor()
    motor.enable()
    began = written_now()
    motor.set_velocity(1.0)
    body.wait_until_it_rests(began, before_rad=0.7 * body.farthest_rad)


@complaint(
    ("dynamixel", mutants.the_end_of_a_session_stops_nothing, "it continued"),
    ("damiao", mutants.the_end_of_a_session_stops_nothing, "it continued"),
    also=("feetech", "cia402"),
)
def test_client_dies_and_the_robot_moves_on(body: Body) -> None:
    with memory_system() as system:
        driver, planner = system.container("driver"), system.container("planner")
        body.attach(register=driver.register, deregister=driver.deregister)
        system.settle()
        group, goal_rad = f"rosie.{body.ways.joint}", 0.9 * body.farthest_rad
        planner.find(where(name="move_to", group=group)).with_(deadline_s=60).start(goal_rad, 0.5)
        body.wait_until_under_way()
        died = written_now()
        system.kill(planner)
        body.wait_until_it_rests(died, before_rad=0.7 * goal_rad)


@complaint(
    ("dynamixel", mutants.enabling_a_dynamixel_writes_torque_alone, "it jumped to"),
    ("feetech", mutants.enabling_a_feetech_writes_torque_alone, "it jumped to"),
    ("damiao", mutants.a_course_begins_at_zero, "it jumped to"),
)
def test_jump_on_re_enable(body: Body) -> None:
    motor = body.motor()
    motor.move_to(0.3)
    motor.relax()
    body.turn_by_hand(-0.4)
    turned = written_now()
    motor.enable()
    body.wait_for_cycles(motor, turned)
    assert abs(body.truth.position_rad + 0.4) < 0.02, f"it jumped to {body.truth.position_rad:.2f} rad"
    assert not body.events("motion_started", turned)


@complaint(
    ("dynamixel", mutants.a_port_that_was_lost_is_not_opened_again, "it answers again"),
    also=("feetech", "cia402", "damiao"),
)
def test_a_fault_needs_a_restart(body: Body) -> None:
    motor = body.motor()
    motor.enable()
    body.strike(Unplug())
    wait_until(lambda: outcome(motor.state), "state() reports it")
    body.strike(Replug())
    wait_until(lambda: outcome(motor.state) == "", "it answers again")
    assert outcome(motor.enable) == ""
    assert abs(motor.move_to(0.3) - 0.3) < 0.03


@complaint(
    ("dynamixel", mutants.two_motions_have_one_joint, "got no error"),
    ("damiao", mutants.two_motions_have_one_joint, "got no error"),
    also=("feetech", "cia402"),
)
def test_two_modes_claim_one_joint(body: Body) -> None:
    motor = body.motor()
    motor.enable()
    by_position = Call(lambda: motor.move_to(0.9 * body.farthest_rad, 0.3))
    body.wait_until_under_way()
    motor.set_velocity(-0.5, valid_s=0.3)
    turned = written_now()
    body.wait_until_it_rests(turned, before_rad=0.5 * body.farthest_rad)
    by_position.join(1.0)
    assert by_position.ended, "the client that moved it by position got no error"
    assert "took over" in by_position.ended


@complaint(
    ("feetech", mutants.a_joint_outside_its_limits_is_refused, "the way back was refused: LimitExceeded"),
    ("cia402", mutants.a_joint_outside_its_limits_is_refused, "the way back was refused: LimitExceeded"),
    also=("dynamixel", "damiao"),
)
def test_a_joint_outside_its_limits_cannot_be_moved_back(body: Body) -> None:
    body.turn_by_hand(body.farthest_rad + 0.2)
    motor = body.motor()
    assert outcome(lambda: motor.move_to(body.farthest_rad + 0.1)).startswith("LimitExceeded")
    assert not body.events("motion_started")
    refusal = outcome(lambda: motor.move_to(body.farthest_rad - 0.2))
    assert not refusal, f"the way back was refused: {refusal}"
    assert abs(body.truth.position_rad - (body.farthest_rad - 0.2)) < 0.03


@complaint(("feetech", mutants.a_servo_may_be_enabled_anywhere, "it moved to 1.4. rad"))
def test_enabling_outside_its_own_limits_moves_a_servo(body: Body) -> None:
    body.rig.plug()
    for name, counts in (("min_angle", 1000), ("max_angle", 3000)):
        body.rig.servo().memory.set(name, counts)
    body.turn_by_hand(1.614)
    motor = body.motor()
    refusal = outcome(motor.enable)
    if not refusal:
        body.rig.wait_for("at_rest", body.device_id)
    assert not body.events("motion_started"), f"it moved to {body.truth.position_rad:.2f} rad"
    assert refusal.startswith("DeviceFault")
    assert not body.moves()


@complaint(
    ("damiao of a wide range", mutants.an_angle_after_a_loss_of_power_is_believed, "it moved to 7"),
    ("cia402", mutants.an_angle_after_a_loss_of_power_is_believed, "it moved to 1"),
)
def test_a_multi_turn_zero_is_lost_with_power(body: Body) -> None:
    was_rad, zero = (3.6, "turn") if body.farthest_rad > 4 else (0.9, "lost")
    motor = body.motor()
    motor.move_to(was_rad)
    body.strike(BrownOut(ids=(1,), zero=zero))
    wait_until(
        lambda: not outcome(motor.state) and motor.state().fault, "it is measured again, and says why it does not move"
    )
    outcome(motor.enable)
    refused = outcome(lambda: motor.move_to(0.9))
    here_rad = body.truth.position_rad
    assert abs(here_rad - was_rad) < 0.05, f"it moved to {here_rad:.2f} rad, past the end of its range"
    assert "in doubt" in refused
    assert f"last known at {was_rad:.1f}" in refused
