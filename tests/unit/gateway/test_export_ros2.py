"""Recordings as bags of ROS 2, read by libraries of other people."""

from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from tests.unit.gateway.test_export import BEGAN_S, S, angle, export, joints, recording
from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.recording._channels import Message, picture
from trade_gateway.recording._file import RecordingFile

PIXELS = bytes(range(12))


def pictures() -> list[Message]:
    at_ns = int(BEGAN_S * S) + S
    made = [
        picture("rosie.eye", PIXELS, "rgb8", 2, 2, at_ns),
        picture("rosie.ear", b"\xff\xd8jpeg", "jpeg", 2, 2, at_ns),
    ]
    return [one._replace(arrived_ns=at_ns + 5) for one in made]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    folder = tmp_path / "bag"
    exported = export(recording(tmp_path / "walk.mcap", *pictures()), folder, "--as", "ros2")
    assert exported.exit_code == 0, exported.output
    assert "/joint_states: 1002 messages" in exported.output
    return folder


def test_joints_and_pictures_are_read_as_messages_of_ros(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        heard = [(one.topic, at, reader.deserialize(data, one.msgtype)) for one, at, data in reader.messages()]
    states = [(at, message) for topic, at, message in heard if topic == "/joint_states"]
    assert len(states) == 1002
    for at, message in states[::100]:
        assert at == message.header.stamp.sec * S + message.header.stamp.nanosec
        since_s = at / S - BEGAN_S
        wanted = {"pan": angle(0, since_s), "tilt": angle(1, since_s), "base": angle(0, since_s - 0.007)}
        got = dict(zip(message.name, message.position, strict=True))
        assert got == pytest.approx({name: wanted[name] for name in got}, abs=1e-6)
    [(_, arrived_ns, raw)] = [one for one in heard if one[0] == "/rosie/eye/image_raw"]
    assert (raw.width, raw.height, raw.encoding, raw.data.tobytes()) == (2, 2, "rgb8", PIXELS)
    assert (arrived_ns, raw.header.frame_id) == (int(BEGAN_S * S) + S + 5, "rosie.eye")
    [(_, _, small)] = [one for one in heard if one[0] == "/rosie/ear/image_raw/compressed"]
    assert (small.format, small.data.tobytes()) == ("jpeg", b"\xff\xd8jpeg")


def test_the_file_has_the_schemas_and_the_encoding_of_rosbag2(bag: Path) -> None:
    [file] = bag.glob("*.mcap")
    with file.open("rb") as opened:
        summary = make_reader(opened).get_summary()
    assert summary is not None
    assert {one.message_encoding for one in summary.channels.values()} == {"cdr"}
    schemas = {one.name: one.encoding for one in summary.schemas.values()}
    kinds = ("JointState", "Image", "CompressedImage")
    assert schemas == {f"sensor_msgs/msg/{kind}": "ros2msg" for kind in kinds}
    assert "sensor_msgs/msg/JointState" in (bag / "metadata.yaml").read_text()


def test_groups_are_chosen_and_joints_have_their_full_names(tmp_path: Path) -> None:
    words = ("--as", "ros2", "--group", "rosie.left.arm", "--names", "full")
    assert export(recording(tmp_path / "walk.mcap"), tmp_path / "bag", *words).exit_code == 0
    with AnyReader([tmp_path / "bag"]) as reader:
        [names] = {tuple(reader.deserialize(data, one.msgtype).name) for one, _, data in reader.messages()}
    assert names == ("rosie.left.arm.base",)


def test_two_joints_of_one_last_name_need_full_names(tmp_path: Path) -> None:
    with RecordingFile(tmp_path / "two.mcap", {}) as file:
        for side in ("left", "right"):
            file.write(joints(f"rosie.{side}", [f"rosie.{side}.elbow"], 0.0))
    refused = export(tmp_path / "two.mcap", tmp_path / "bag", "--as", "ros2")
    assert isinstance(refused.exception, ConfigurationError)
    assert "would have one name" in str(refused.exception)
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--as", "ros2", "--fps", "30"), "--fps: is only for --as lerobot"),
        (("--as", "ros2", "--episodes", "locks"), "--episodes: is only for --as lerobot"),
        (("--names", "full"), "--names: is only for --as ros2"),
        (("--as", "ros2", "--group", "dora"), "has no dora; it has rosie.head, rosie.left.arm"),
    ],
)
def test_options_of_the_other_form_are_refused(tmp_path: Path, words: tuple[str, ...], says: str) -> None:
    refused = export(recording(tmp_path / "walk.mcap", seconds=1), tmp_path / "out", *words)
    assert isinstance(refused.exception, UsageError), refused.output
    assert says in str(refused.exception)
    assert not (tmp_path / "out").exists()


def test_a_folder_with_files_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "mine.txt").write_text("mine")
    refused = export(recording(tmp_path / "walk.mcap", seconds=1), tmp_path / "bag", "--as", "ros2")
    assert "is not empty" in str(refused.exception)
    assert [path.name for path in (tmp_path / "bag").iterdir()] == ["mine.txt"]
