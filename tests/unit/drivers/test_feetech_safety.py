"""The motion rules on Feetech servos, by their numbers; the judge is what the simulated servos received and did.

They have no watchdog: what S06 asks of the device is missing, and these tests show what the driver does instead.
"""

from types import SimpleNamespace

import pytest

import trade_hil_sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.tail_rig import TailRig, goal_of, lead_counts, measured_before, rig, tail
from trade.errors import LockedByOther

pytestmark = pytest.mark.virtual_time

__all__ = ["rig", "tail"]


def test_S06_no_servo_has_a_watchdog_so_no_goal_is_farther_ahead_than_the_joint_gets_until_the_next(
    tail: TailRig,
) -> None:
    root = tail.root()
    root.enable()
    mark = written_now()
    root.move_to(1.2, 1.0)
    log, reported = tail.log, tail.goals(1, mark)
    assert len(reported) > 10
    for write in reported:
        assert abs(goal_of(write) - measured_before(log, write)) <= lead_counts(1.0)


def test_S06_no_set_point_is_farther_ahead_than_the_joint_gets_until_the_next(tail: TailRig) -> None:
    root = tail.root()
    root.enable()
    mark = written_now()
    root.set_velocity(0.5, 1.0)
    tail.wait_for("at_rest", 1, mark)
    log = tail.log
    reported = [write for write in tail.goals(1, mark) if write.name == "sync_write"]
    assert all(abs(goal_of(write) - measured_before(log, write)) <= lead_counts(0.5) for write in reported)


def test_S08_a_stop_of_a_relaxed_joint_sends_it_no_goal(tail: TailRig) -> None:
    """Some say that a goal switches the torque of these servos on."""
    robot = tail.attach()
    robot.motor("tail.root").stop()
    robot.group("tail").stop()
    assert not tail.moves()


def test_S11_the_bus_thread_itself_leads_on_only_under_the_live_grant(tail: TailRig) -> None:
    root = tail.root()
    root.enable()
    moving = Outcome(lambda: root.move_to(1.3, 0.2))
    wait_until(lambda: tail.truth().position_rad > 0.1 or moving.error, "it is under way")

    def gone() -> None:
        raise LockedByOther(resources=["rosie.tail.root"], owner="another")

    [axis] = root._axes  # type: ignore[attr-defined]
    axis.motion.permit = SimpleNamespace(gate=gone)
    assert isinstance(moving.wait().error, LockedByOther)
    mark = written_now()
    tail.wait_for("at_rest", 1)
    assert all(goal_of(entry) <= tail.truth().position_counts + 1 for entry in tail.goals(1, mark))


def test_S18_attaching_to_enabled_servos_writes_nothing_either(rig: TailRig) -> None:
    rig.plug(prepare=lambda sim: [servo.write(40, b"\1", written_now()) for servo in sim.devices] and None)
    assert rig.root().state().enabled
    assert not trade_hil_sim.writes(rig.log)
