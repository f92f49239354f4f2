"""A robot without some of its parts: what goes with them, what stays, and what is refused."""

from pathlib import Path

import pytest

from trade.errors import ConfigurationError
from trade_drivers import Robot, load, parse, without

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture(scope="module")
def rosie() -> Robot:
    return load(EXAMPLES / "rosie.toml")


def test_nothing_left_out_is_the_whole_robot(rosie: Robot) -> None:
    assert without(rosie, []) == (rosie, [])


def test_leaving_out_a_bus_leaves_out_its_devices_and_their_groups(rosie: Robot) -> None:
    rest, gone = without(rosie, ["legs", "left_arm"])
    assert [bus.name for bus in rest.buses] == ["neck", "hand", "right_arm", "tail"]
    assert gone == [*(joint.name for joint in rosie.joints_on("legs")), "left.arm", "legs"]
    assert [group.name for group in rest.groups] == ["head", "right.arm", "tail"]
    assert not rest.arms
    assert "rosie.legs" not in rest.members()
    assert rest.members()["rosie.left"] == ["rosie.left.hand"]


def test_a_camera_is_left_out_by_its_own_name() -> None:
    robot = load(EXAMPLES / "eye.toml")
    rest, gone = without(robot, ["eye"])
    assert (rest.cameras, rest.joints, gone) == ([], robot.joints, ["eye"])


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        (["legs", "wing"], "there is no bus, camera or sensor 'wing' to leave out; there is hand, left_arm, legs"),
        (["left.arm"], "there is no bus, camera or sensor 'left.arm'"),
        (["neck", "left_arm", "hand", "right_arm", "legs", "tail"], "nothing would be left of the robot"),
    ],
)
def test_what_cannot_be_left_out_is_refused(rosie: Robot, names: list[str], complaint: str) -> None:
    with pytest.raises(ConfigurationError, match=complaint):
        without(rosie, names)


def test_coupled_joints_are_kept_or_left_out_together() -> None:
    text = (EXAMPLES / "dora.toml").read_text(encoding="utf-8")
    robot = parse(text, "dora.toml")
    one, other = (robot.joints_on(bus.name)[0].name for bus in robot.buses[:2])
    coupled = parse(f'{text}\n[[coupled]]\njoints = ["{one}", "{other}"]\n', "dora.toml")
    with pytest.raises(ConfigurationError, match=f"{one} is coupled to {other}, which is left out"):
        without(coupled, [robot.buses[1].name])
