"""The contract of arms, on a simulated UR5e, and what is said of a controller that cannot be attached."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from arms import ARM, attached
from trade.errors import ConfigurationError
from trade_drivers import Arm, parse
from trade_drivers.testing import ArmContract
from trade_hil_sim import Absent, UrBus
from trade_hil_sim import Arm as SimArm

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")


class TestArm(ArmContract):
    @pytest.fixture
    def arm(self) -> Iterator[Arm]:
        with ExitStack() as undo:
            _, robot = attached(undo)
            yield robot.arm("right")


def test_an_arm_of_another_model_is_not_taken() -> None:
    with ExitStack() as undo, pytest.raises(ConfigurationError, match="has a UR10, not a UR5e"):
        attached(undo, SimArm("UR10e", name="right"))


def test_an_address_where_nobody_is_or_answers_is_named() -> None:
    with UrBus() as silent:
        silent.do(Absent())
        for host in ("127.0.0.213", silent.port):
            with ExitStack() as undo, pytest.raises(ConfigurationError, match=host):
                attached(undo, host=host)


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ('host = "192.168.0.10"', 'port = "/dev/ttyUSB0"', "driver ur needs a controller"),
        ('model = "UR5e"', 'model = "PUMA"', "it knows UR3, UR3e"),
        ('host = "192.168.0.10"', 'host = "192.168.0.10"\nleave = "relax"', "it would fall"),
        ("max_speed_rad_s = 1.0", "max_speed_rad_s = -1.0", "max_speed_rad_s"),
        ("0.1, 2.8", "-3.2, 2.8", "must be greater than min_rad"),
        ("home = [0.0,", "home = [9.0,", "poses.home: 9.0 of joint 0 is outside"),
        ("home = [0.0,", "home = [nan,", "must be finite"),
        ("home = [0.0,", "home = [", "poses"),
    ],
)
def test_a_mistake_in_the_robot_file_is_answered_with_the_key(before: str, after: str, complaint: str) -> None:
    assert before in ARM
    with ExitStack() as undo, pytest.raises(ConfigurationError, match=complaint):
        attached(undo, text=ARM.replace(before, after), host="127.0.0.213")


def test_a_controller_has_one_arm() -> None:
    twice = ARM + ARM[ARM.index("[arm.right]") :].replace("right", "left")
    with pytest.raises(ConfigurationError, match="has its one arm"):
        parse(twice, "arm.toml")
