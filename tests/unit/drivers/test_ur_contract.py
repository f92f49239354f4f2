"""The contract of arms, on a simulated UR5e, and what is said of a controller that cannot be attached."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.arm_rig import ArmRig
from tests.unit.drivers.attached_arm import ARM, AT_HOME, attached
from trade.errors import ConfigurationError
from trade_drivers import Arm, parse
from trade_drivers.testing import ArmContract
from trade_hil_sim import Arm as SimArm
from trade_hil_sim import instructions

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")


class TestArm(ArmContract):
    @pytest.fixture
    def arm(self) -> Iterator[Arm]:
        with ExitStack() as undo:
            yield ArmRig(undo).attach().arm("right")


OLDER = ARM.replace('model = "UR5e"', 'model = "UR10"')


class TestOlderArm(ArmContract):
    """Behind a CB3, which has 125 cycles a second and no fields of the e-Series."""

    @pytest.fixture
    def arm(self) -> Iterator[Arm]:
        with ExitStack() as undo:
            yield ArmRig(undo, SimArm("UR10", name="right"), OLDER).attach().arm("right")


@pytest.mark.slow
@pytest.mark.parametrize(("model", "text", "most"), [("UR10", OLDER, 125), ("UR5e", ARM, 500)])
def test_a_stream_has_the_rate_of_the_controller(model: str, text: str, most: int) -> None:
    with ExitStack() as undo:
        rig = ArmRig(undo, SimArm(model, name="right"), text)
        rig.attach()
        assert rig.arm._exchange.period_ns == 10**9 // most  # type: ignore[attr-defined]
        rig.arm.servo([0.1, *AT_HOME[1:]], 1.0)
        wait_until(lambda: not rig.arm.resources[0].moving, "the set-point has ended")
        streamed = [entry.t for entry in instructions(rig.log, "servo_j")]
        assert len(streamed) <= most * (streamed[-1] - streamed[0]) * 1.1 + 2


@pytest.mark.slow
def test_an_address_without_a_listener_is_named() -> None:
    with ExitStack() as undo, pytest.raises(ConfigurationError, match=r"127\.0\.0\.213"):
        attached(undo, "127.0.0.213")


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ('host = "192.168.0.10"', 'port = "/dev/ttyUSB0"', "driver ur needs a controller"),
        ('model = "UR5e"', 'model = "PUMA"', "it knows UR3, UR5, UR10, UR3e"),
        ('host = "192.168.0.10"', 'host = "192.168.0.10"\nleave = "relax"', "it would fall"),
        ('driver = "ur"', 'driver = "ur"\nrate_hz = 501', "rate_hz"),
        (
            'host = "192.168.0.10"',
            'host = "192.168.0.10"\nrate_hz = 250',
            "more than the 125 cycles a second of a UR10",
        ),
        ("max_speed_rad_s = 1.0", "max_speed_rad_s = -1.0", "max_speed_rad_s"),
        ("0.1, 2.8", "-3.2, 2.8", "must be greater than min_rad"),
        ("home = [0.0,", "home = [9.0,", "poses.home: 9.0 of joint 0 is outside"),
        ("home = [0.0,", "home = [nan,", "must be finite"),
        ("home = [0.0,", "home = [", "poses"),
    ],
)
def test_a_mistake_in_the_robot_file_is_answered_with_the_key(before: str, after: str, complaint: str) -> None:
    text = OLDER if "of a UR10" in complaint else ARM
    assert before in text
    with ExitStack() as undo, pytest.raises(ConfigurationError, match=complaint):
        attached(undo, "127.0.0.213", text.replace(before, after))


def test_a_controller_has_one_arm() -> None:
    twice = ARM + ARM[ARM.index("[arm.right]") :].replace("right", "left")
    with pytest.raises(ConfigurationError, match="has its one arm"):
        parse(twice, "arm.toml")
