"""A profile at the limits of a joint, on every vendor's stream of set-points; the judge is what the device received."""

from contextlib import ExitStack

import pytest

from tests.contract.rigs.joints import JointRig
from tests.unit.drivers.arm_rig import ArmRig
from tests.unit.drivers.conftest import written_now
from trade.errors import LimitExceeded
from trade_drivers import JointLimits, Tolerances, Trajectory, TrajectoryPoint

_EVERY_S = 0.07
"""No whole part of the ramps: between two points, a cubic curve breaks the limits."""


def trapezoid(joints: list[str], starts: list[float], limits: JointLimits, end_rad: float, factor: float) -> Trajectory:
    """The first joint goes to an angle at its greatest speed and acceleration, the others stay."""
    speed, accel, way = limits.max_speed_rad_s, limits.max_accel_rad_s2 * factor, end_rad - starts[0]
    ramp_s = speed / accel
    duration_s = way / speed + ramp_s

    def at(time_s: float) -> tuple[float, float]:
        ramping_s = min(time_s, duration_s - time_s, ramp_s)
        done, slower = accel * ramping_s**2 / 2, accel * ramping_s
        if time_s > duration_s - ramp_s:
            return end_rad - done, slower
        return starts[0] + done + speed * max(0.0, time_s - ramp_s), slower

    times = [_EVERY_S * number for number in range(int(duration_s / _EVERY_S) + 1)] + [duration_s]
    return Trajectory(
        joints=joints,
        points=[
            TrajectoryPoint(
                time_from_start_s=time_s,
                positions_rad=[at(time_s)[0], *starts[1:]],
                velocities_rad_s=[at(time_s)[1], *(0.0 for _ in starts[1:])],
            )
            for time_s in times
        ],
    )


def test_S22_a_profile_at_the_limits_is_followed_to_the_end_of_the_range(rig: JointRig) -> None:
    rig.attach()
    group = rig.robot.group(rig.group)
    group.enable()
    starts, limits = [state.position_rad for state in group.state()], group.limits()[0]
    mark = written_now()
    for factor in (1.1, 1.3):
        with pytest.raises(LimitExceeded, match="acceleration"):
            group.follow(trapezoid(group.joints(), starts, limits, rig.max_rad, factor))
    assert not rig.sent_away(mark)
    ended = group.follow(trapezoid(group.joints(), starts, limits, rig.max_rad, 1.0), Tolerances(path_rad=0.5))
    assert ended[0] == pytest.approx(rig.max_rad, abs=rig.within_rad)
    sent = rig.targets_rad(mark)
    assert max(sent) <= rig.max_rad + rig.exactly_rad
    assert rig.truth().position_rad == pytest.approx(rig.max_rad, abs=rig.within_rad)


@pytest.mark.realtime
def test_S22_an_arm_follows_a_profile_at_the_limits_of_a_joint() -> None:
    with ExitStack() as undo:
        rig = ArmRig(undo)
        rig.attach()
        joints = rig.arm.limits().joints
        names, starts, limits = [joint.name for joint in joints], rig.arm.state().positions_rad, joints[0]
        for factor in (1.1, 1.3):
            with pytest.raises(LimitExceeded, match="acceleration"):
                rig.arm.follow(trapezoid(names, starts, limits, starts[0] + 1.0, factor))
        assert not rig.moves()
        rig.arm.follow(trapezoid(names, starts, limits, starts[0] + 1.0, 1.0), Tolerances(path_rad=0.5))
        assert rig.base_rad == pytest.approx(starts[0] + 1.0, abs=0.01)
