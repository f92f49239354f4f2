"""Complaints of other projects about drives that are not what the robot file says."""

from typing import Any

import pytest

from tests.contract.complaints import drive_mutants as mutants
from tests.contract.complaints.bodies import Body, outcome
from tests.contract.complaints.table import complaint
from tests.support.can_queue import QueuedBus
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from trade_hil_sim.cia402 import Object, factor_objects, unit_objects

pytestmark = pytest.mark.virtual_time

_REV_PER_MIN, _RPM_PER_S = 0x00B44700, 0x00C00300


def _plug(body: Body, *objects: Object, strict: bool = False) -> None:
    """Plug in drives that say this of themselves; strict ones take a mapping only while pre-operational."""

    def prepare(sim: Any) -> None:
        for drive in sim.devices:
            drive.says(*objects)
            if strict:
                drive.node.map_only_pre_operational()

    body.rig.plug(prepare=prepare)


@complaint(("cia402", mutants.all_speeds_are_counts, "it moved 0.60 rad in 0.0"))
def test_a_speed_is_taken_for_another_unit(body: Body) -> None:
    _plug(body, *unit_objects(velocity=_REV_PER_MIN, acceleration=_RPM_PER_S))
    motor = body.motor()
    began = written_now()
    motor.move_to(0.6)
    wait_until(lambda: body.events("at_rest", began), "it rests")
    took_s = body.events("at_rest", began)[0].t - body.events("motion_started", began)[0].t
    fastest = body.rig.robot.joints[0].max_speed_rad_s
    assert took_s > 0.6 / fastest, f"it moved {body.truth.position_rad:.2f} rad in {took_s:.3f} s"


@complaint(("cia402", mutants.the_file_alone_has_the_scale, "a wrong scale was not refused"))
def test_a_wrong_scale_moves_a_joint_past_its_range(body: Body) -> None:
    _plug(body, *factor_objects(encoder=(1024, 1)))
    refusal = outcome(lambda: body.motor().move_to(0.3))
    assert refusal.startswith("ConfigurationError"), f"a wrong scale was not refused: {refusal}"
    assert "4096" in refusal
    assert "1024" in refusal
    assert not body.moves()


@complaint(("cia402", mutants.a_drive_is_mapped_in_any_state, "the second start ended with ConfigurationError"))
def test_a_drive_cannot_be_set_up_a_second_time(body: Body) -> None:
    _plug(body, strict=True)
    robot = body.attach()
    robot.motor(body.ways.joint).move_to(0.3)
    robot.close()
    began = written_now()
    refusal = outcome(body.attach)
    assert not refusal, f"the second start ended with {refusal}"
    assert not body.events("motion_started", began)
    assert not body.events("torque_off", began)


@complaint(
    ("cia402", mutants.a_full_queue_is_a_lost_port, "a frame that had to wait ended the motion"),
    ("damiao", mutants.a_full_queue_is_a_lost_port, "a frame that had to wait ended the motion"),
)
def test_a_short_send_queue_ends_a_motion(body: Body) -> None:
    body.rig.plug()
    with QueuedBus.offered():
        port, bus = body.rig.sim.port.replace("socketcand", "queued"), body.rig.robot.buses[0].name
        group = body.attach(ports={bus: port}).group(body.rig.robot.groups[0].name)
        group.enable()
        QueuedBus.full_every = 5
        refusal = outcome(lambda: group.move_to([0.3, 0.3]))
        assert QueuedBus.refused
        assert not refusal, f"a frame that had to wait ended the motion: {refusal}"
        QueuedBus.length = 0
        wait_until(lambda: "its send queue has been full" in outcome(group.relax), "it is named")
