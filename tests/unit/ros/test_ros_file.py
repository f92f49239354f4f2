"""The file of a bridge is read as a whole: what is wrong in it is named, with what would be right."""

from pathlib import Path

import pytest

from tests.unit.ros.robots import Stand
from trade.errors import ConfigurationError
from trade_gateway.ros._connect import join, planned
from trade_gateway.ros._file import read_ros_file
from trade_gateway.ros_messages._conversion import ros_path

pytestmark = pytest.mark.virtual_time

EXAMPLE = Path(__file__).parents[3] / "examples" / "ros.toml"
HEAD = "[ros]\nversion = 2\n"
SERVICE = '[[to_ros.service]]\ntype = "std_srvs/srv/Trigger"\n'
FROM = '[[from_ros.service]]\nservice = "/go"\ntype = "std_srvs/srv/Trigger"\ngroups = ["lab"]\n'
PUBLISH = '[[from_ros.publish]]\ntopic = "/go"\ntype = "std_msgs/msg/Empty"\ngroups = ["lab"]\n'
COMMAND = '[[to_ros.command]]\ntopic = "/go"\ntype = "std_msgs/msg/Float64"\nservice = "a.go"\n'


def test_the_example_is_right_and_says_what_it_maps() -> None:
    lines = planned(read_ros_file(EXAMPLE), EXAMPLE)
    assert "to ROS: a lock over rosie.head as std_srvs/srv/SetBool /rosie/head/lock" in lines
    assert "from ROS: publishing on /cmd_vel (geometry_msgs/msg/Twist) in base" in lines


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "ros: is missing"),
        ("[ros]\n", "ros.version: is missing"),
        ("[ros]\nversion = 3\n", "Invalid enum value 3"),
        (HEAD + "colour = 1\n", "ros.colour: unknown key"),
        ("[ros\n", "not valid TOML"),
        (HEAD + SERVICE, r"to_ros.service\[0\]: needs either group"),
        (HEAD + SERVICE + 'group = "a"\nservice = "a.b"\n', "needs either group"),
        (HEAD + SERVICE + 'group = "a"\nname = "/x"\n', "names one service"),
        (HEAD + SERVICE + 'service = "a.b"\nname = "x y"\n', "is not a ROS name"),
        (HEAD + SERVICE + 'service = "a.b"\nnames = ["b"]\n', "selects services of a group"),
        (HEAD + SERVICE.replace("std_srvs/srv/Trigger", "Trigger") + 'group = "a"\n', "a type is written"),
        (HEAD + COMMAND.replace("/go", "/g o"), "is not a ROS name"),
        (HEAD + COMMAND + "deadman_s = 60\n", "<= 10"),
        (HEAD + COMMAND + COMMAND, "/go occurs twice"),
        (HEAD + FROM, "effect: is missing"),
        (HEAD + FROM + 'effect = "actuate"\n', r"stop: is missing: what moves something needs"),
        (HEAD + FROM + 'effect = "read"\nstop = "/stop"\n', "does not go with effect"),
        (HEAD + FROM + 'effect = "stop"\n', "Invalid enum value 'stop'"),
        (HEAD + PUBLISH + 'effect = "actuate"\n', "needs a message that stops it"),
        (HEAD + PUBLISH + 'effect = "note"\nstop = {}\n', "does not go with effect"),
        (HEAD + PUBLISH + 'effect = "note"\n' + COMMAND, "would command the bridge's own service again"),
    ],
)
def test_what_is_wrong_is_named_with_what_would_be_right(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "ros.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=says) as refused:
        read_ros_file(path)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HEAD + SERVICE.replace("Trigger", "Tricker") + 'group = "a"\n', "Tricker is not known"),
        (HEAD + COMMAND.replace("std_msgs/msg/Float64", "std_srvs/srv/Trigger"), "is not known"),
        (HEAD + 'master = "http://localhost:11311"\n', "is a key for ROS 1, but version is 2"),
        ('[ros]\nversion = 1\nrouter = "tcp/localhost:7447"\n', "is a key for ROS 2, but version is 1"),
        (HEAD + 'types = ["nowhere"]\n', "there is no such folder"),
    ],
)
def test_an_invalid_mapping_is_rejected_before_joining_ros(stand: Stand, text: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=says):
        planned(stand.read(text, ""), stand.folder / "ros.toml")


def test_a_ros_that_this_installation_cannot_speak_with_is_named(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "trade_gateway.ros.ros2", None)
    with pytest.raises(ConfigurationError, match="cannot communicate with ROS 2"):
        join(stand.read("", HEAD), stand.folder / "ros.toml")


def test_groups_become_paths_that_ros_takes() -> None:
    assert ros_path("rosie.left.arm", "stop") == "/rosie/left/arm/stop"
    assert ros_path("robot-2.3d", "stop") == "/robot_2/_3d/stop"
