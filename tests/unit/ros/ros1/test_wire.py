"""Names, texts and MD5 sums, as the generators of ROS 1 make them."""

import ast
import json
import subprocess
from pathlib import Path

import pytest

from tests.support.ros1_system import PYTHON, need_ros1
from trade.errors import ConfigurationError
from trade_gateway.ros import ros1
from trade_gateway.ros.ros1._wire import action_types, message_head, service_head
from trade_gateway.ros_messages._types import Types

MESSAGES = [
    "std_msgs/msg/Empty",
    "std_msgs/msg/Header",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/PointCloud2",
    "trajectory_msgs/msg/JointTrajectory",
    "actionlib_msgs/msg/GoalStatusArray",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
]
SERVICES = ["std_srvs/srv/Empty", "std_srvs/srv/Trigger", "std_srvs/srv/SetBool", "sensor_msgs/srv/SetCameraInfo"]
ACTIONS = ["actionlib/action/Test", "move_base_msgs/action/MoveBase"]
DEFINITIONS = {
    "actionlib/action/Test.action": "int32 goal\n---\nint32 result\n---\nint32 feedback\n",
    "move_base_msgs/action/MoveBase.action": (
        "geometry_msgs/PoseStamped target_pose\n---\n---\ngeometry_msgs/PoseStamped base_position\n"
    ),
    "sensor_msgs/srv/SetCameraInfo.srv": (
        "# as cameras have it\nsensor_msgs/CameraInfo camera_info   # to store\n"
        "---\nbool success\nstring status_message\n"
    ),
}
GENUINE = """
import genpy.dynamic, json, roslib.message, sys
types = {}
for name, text in json.load(sys.stdin).items():
    kind = roslib.message.get_message_class(name) or roslib.message.get_service_class(name)
    made = genpy.dynamic.generate_dynamic(name, text)[name]._md5sum if text else ""
    types[name] = [kind._type, kind._md5sum, made]
print(json.dumps(types))
"""


@pytest.fixture(scope="module")
def types(tmp_path_factory: pytest.TempPathFactory) -> Types:
    folder = tmp_path_factory.mktemp("types")
    for name, text in DEFINITIONS.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return Types(1, [folder])


@pytest.mark.realtime
def test_types_are_named_and_summed_as_ros_does(types: Types) -> None:
    need_ros1()
    around = [made for action in ACTIONS for made in action_types(types, action)]
    heads = [message_head(types, name) for name in [*MESSAGES, *around]]
    heads += [service_head(types, name) for name in SERVICES]
    texts = {head["type"]: head.get("text", "") for head in heads}
    command = [PYTHON, "-c", GENUINE]
    ran = subprocess.run(command, input=json.dumps(texts), capture_output=True, text=True, timeout=60, check=True)
    for head in heads:
        kind, checked, of_text = json.loads(ran.stdout)[head["type"]]
        assert (head["type"], head["md5"]) == (kind, checked)
        assert of_text == (checked if head.get("text") else "")


def test_parts_of_services_are_named_as_ros_does(types: Types) -> None:
    head = service_head(types, "std_srvs/srv/SetBool")
    assert (head["request"]["type"], head["response"]["type"]) == (
        "std_srvs/SetBoolRequest",
        "std_srvs/SetBoolResponse",
    )


def test_the_node_is_written_for_the_python_of_older_distributions() -> None:
    for path in sorted((Path(ros1.__file__).parent / "_node").glob("*.py")):
        ast.parse(path.read_text(), filename=str(path), feature_version=(3, 8))


@pytest.mark.timeout(30)
def test_an_array_of_what_has_no_bytes_is_refused_before_one_comes(tmp_path: Path) -> None:
    """Its length is only claimed: four bytes would keep the bridge at it for hours."""
    folder = tmp_path / "custom" / "msg"
    folder.mkdir(parents=True)
    (folder / "Nothing.msg").write_text("std_msgs/Empty[2] inner\n")
    (folder / "Row.msg").write_text("string name\nNothing[] many\n")
    (folder / "Table.msg").write_text("Row[] rows\n")
    types = Types(1, [tmp_path])
    assert types.from_bytes("custom/msg/Nothing", b"") == {"inner": [{}, {}]}
    for name in ("Row", "Table"):
        with pytest.raises(ConfigurationError, match="many is an array of custom/msg/Nothing, which has no bytes"):
            types.from_bytes(f"custom/msg/{name}", b"\x01\x00\x00\x00" + bytes(4) + b"\xff\xff\xff\x0f")
