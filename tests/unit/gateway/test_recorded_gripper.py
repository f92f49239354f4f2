"""A gripper in a recording and in what is exported from it: one joint, whose position is its width in m."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as parquet
import pytest
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner, Result

from tests.unit.ros.arms import FakeJoints
from trade.testing import memory_system
from trade_drivers.testing import FakeGripper
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.recording._channels import JointStates, Message, encoded, joints_channel
from trade_gateway.recording._file import RecordingFile
from trade_gateway.recording._motion import motions
from trade_gateway.recording._recorder import Recorder
from trade_gateway.recording._sources import RecordedParts
from trade_gateway.recording.commands._replay_run import chosen

pytestmark = pytest.mark.virtual_time
HAND, ARM = "rosie.left.hand", "rosie.left.arm"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two seconds of an arm at rest and a gripper that closes after one, and has a fault at the end."""
    hand, arm, ending = FakeGripper(HAND), FakeJoints(f"{ARM}.a"), threading.Event()
    with memory_system() as system:
        robot, recorder = system.container("robot"), system.container("recorder")
        robot.register(hand, HAND)
        robot.register(arm, ARM)
        system.settle()
        hand.activate()
        path = tmp_path / "pick.mcap"
        with RecordingFile(path, {}) as file, Recorder(recorder, RecordedParts(groups=["rosie"]), ending) as running:
            assert running.look() == [f"{ARM}.state", f"{HAND}.state"]
            steps = using(hand)
            running.run(file, 2.5, lambda: next(steps, None))
    return path


def using(hand: FakeGripper) -> Iterator[None]:
    hand.close()
    yield
    hand.fail("jammed")
    yield


def export(*words: str | Path) -> Result:
    done = CliRunner().invoke(app, ["export", *map(str, words)])
    assert done.exit_code == 0, done.output
    return done


def test_a_recording_has_the_width_of_a_gripper_its_speed_and_its_faults(recording: Path) -> None:
    states = motions(recording)[HAND]
    assert states[0].names == [HAND]
    assert (states[0].width_m, states[-1].width_m) == ([0.085], [0.0])
    assert all((one.speed_m_s, one.position_rad, one.velocity_rad_s) == ([0.0], [], []) for one in states)
    assert {one.enabled[0] for one in states} == {True}
    assert states[-1].fault == ["jammed"]


def test_joints_beside_a_gripper_are_recorded_as_ever(recording: Path) -> None:
    states = motions(recording)[ARM]
    assert all((one.names, one.position_rad, one.width_m) == ([f"{ARM}.a"], [0.0], []) for one in states)


def test_a_gripper_is_a_column_of_a_dataset(recording: Path, tmp_path: Path) -> None:
    done = export(recording, tmp_path / "set", "--json")
    assert json.loads(done.stdout)["joints"] == [f"{ARM}.a", HAND]
    rows = parquet.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pylist()
    widths = [row["observation.state"][1] for row in rows]
    assert (widths[0], widths[-1]) == (pytest.approx(0.085), 0.0)
    assert {row["observation.state"][0] for row in rows} == {0.0}


def test_a_gripper_is_a_joint_of_a_bag_of_ros(recording: Path, tmp_path: Path) -> None:
    export(recording, tmp_path / "bag", "--as", "ros2")
    with AnyReader([tmp_path / "bag"]) as reader:
        states = [reader.deserialize(data, one.msgtype) for one, _, data in reader.messages()]
    widths = [one.position[0] for one in states if one.name == ["hand"]]
    assert (widths[0], widths[-1]) == (0.085, 0.0)
    assert any(one.name == ["a"] for one in states)


def test_a_replay_moves_no_gripper_and_still_finds_the_arm_beside_it(recording: Path) -> None:
    assert chosen(recording, None).group == ARM
    with pytest.raises(UsageError, match=f"{HAND} is a gripper; only joints and arms of TRADE are replayed"):
        chosen(recording, HAND)


def test_a_replay_moves_no_joints_of_ros(tmp_path: Path) -> None:
    states = JointStates(
        names=["lab.arm.a"], position_rad=[0.1], velocity_rad_s=[], load=[], enabled=[], fault=[], stamp_s=[1.0]
    )
    with RecordingFile(tmp_path / "lab.mcap", {}) as file:
        file.write(Message(joints_channel("lab.arm"), 10**9, 10**9, encoded(states)))
    with pytest.raises(UsageError, match=r"lab\.arm is of ROS; only joints and arms of TRADE are replayed"):
        chosen(tmp_path / "lab.mcap", "lab.arm")
