"""Locks in a recording of one group, whose joints have names of another group."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.unit.ros.arms import FakeJoints
from trade import Container
from trade.testing import memory_system
from trade_gateway.cli import app
from trade_gateway.recording._channels import LOCKS
from trade_gateway.recording._file import RecordingFile
from trade_gateway.recording._reader import entries
from trade_gateway.recording._recorder import Recorder
from trade_gateway.recording._sources import RecordedParts

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return recording_of_the_head(tmp_path)


def recording_of_the_head(folder: Path) -> Path:
    """A recording of the head alone, in which the head, one of its joints and the tail were locked."""
    ending = threading.Event()
    with memory_system() as system:
        robot, recorder, planner = (system.container(name) for name in ("robot", "recorder", "planner"))
        robot.register(FakeJoints("rosie.neck.pan", "rosie.neck.tilt"), "rosie.head")
        robot.register(FakeJoints("rosie.back.wag"), "rosie.tail")
        system.settle()
        path = folder / "nod.mcap"
        with (
            RecordingFile(path, {}) as file,
            Recorder(recorder, RecordedParts(groups=["rosie.head"]), ending) as running,
        ):
            assert running.look() == ["rosie.head.state"]
            steps = locking(planner)
            running.run(file, 7.5, lambda: next(steps, None))
    return path


def locking(planner: Container) -> Iterator[None]:
    """A lock every two seconds, each for one second."""
    for what, purpose in (("rosie.head", "nod"), ("rosie.tail", "wag"), ("rosie.head", "shake")):
        with planner.lock(what, purpose=purpose):
            yield
        yield


def test_the_locks_of_the_joints_of_a_group_are_recorded_with_it(recording: Path) -> None:
    found = [json.loads(entry.data)["locks"] for entry in entries(recording) if entry.topic == LOCKS.topic]
    held = {(lock["purpose"], *sorted(lock["resources"])) for locks in found for lock in locks}
    joints = ("rosie.neck.pan", "rosie.neck.tilt")
    assert held == {("nod", *joints), ("shake", *joints)}


def test_each_lock_of_the_group_is_an_episode(recording: Path, tmp_path: Path) -> None:
    words = ["export", str(recording), str(tmp_path / "set"), "--episodes", "locks", "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output or done.exception
    assert json.loads(done.stdout)["tasks"] == ["nod", "shake"]
