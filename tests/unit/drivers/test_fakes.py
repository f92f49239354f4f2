"""A joint group in memory keeps what the contract of joint groups says of everything but time."""

import pytest

from trade import where
from trade.errors import Stopped
from trade.testing import memory_system
from trade_drivers import JointGroup
from trade_drivers.testing import FakeJointGroup, JointGroupContract

JOINTS = ["rosie.neck.pan", "rosie.neck.tilt"]


class TestFakeJointGroup(JointGroupContract):
    @pytest.fixture
    def group(self) -> JointGroup:
        return FakeJointGroup(JOINTS)

    # these are of motion that takes time
    test_joints_with_ways_of_different_length_are_on_their_way_together = None  # type: ignore[assignment]
    test_stop_ends_the_motion_of_all_and_the_mover_hears_of_it = None  # type: ignore[assignment]
    test_its_progress_is_reported = None  # type: ignore[assignment]
    test_stop_ends_a_trajectory = None  # type: ignore[assignment]
    test_a_move_takes_over_from_a_trajectory = None  # type: ignore[assignment]


def test_it_is_found_as_a_joint_group_and_an_e_stop_holds_it() -> None:
    group = FakeJointGroup(JOINTS)
    with memory_system() as system:
        robot, mind = system.container("robot"), system.container("mind")
        robot.register(group, "rosie.head")
        move = mind.find(where(name="move_to", group="rosie.head", kind="JointGroup"))
        assert move([0.3, -0.2]) == [0.3, -0.2]
        assert mind.find(where(name="state", group="rosie.head"))()[0].position_rad == 0.3
        assert system.container("guard").estop("smoke").complete
        with pytest.raises(Stopped):
            move([0.0, 0.0])
    assert group.went == [[0.3, -0.2]]
