"""Recordings as datasets of episodes: where episodes begin and end, what is in a frame, and how tables are laid out."""

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet
import pytest
from typer.testing import CliRunner, Result

from trade.errors import ConfigurationError
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.recording._channels import LOCKS, JointStates, Lock, Locks, Message, encoded, joints_channel
from trade_gateway.recording._file import RecordingFile

S = 1_000_000_000
BEGAN_S = 1000.0
HEAD = ["rosie.neck.pan", "rosie.neck.tilt"]
ARM = ["rosie.left.arm.base"]


def angle(joint: int, at_s: float) -> float:
    """Where a joint was, so many seconds after the beginning: it turns evenly, each at its own speed."""
    return (joint + 1) * 0.1 * at_s


def joints(group: str, names: list[str], at_s: float) -> Message:
    count = len(names)
    states = JointStates(
        names=names,
        position_rad=[angle(number, at_s) for number in range(count)],
        velocity_rad_s=[0.0] * count,
        load=[],
        enabled=[True] * count,
        fault=[""] * count,
        stamp_s=[BEGAN_S + at_s] * count,
    )
    at_ns = int((BEGAN_S + at_s) * S)
    return Message(joints_channel(group), at_ns, at_ns, encoded(states))


def locks(at_s: float, *held: tuple[str, str, float]) -> Message:
    """Who has what since when: purpose, resource, seconds after the beginning."""
    all_ = [
        Lock(container=name, resources=[name], owner="ann", purpose=purpose, since_s=BEGAN_S + since_s, waiting=[])
        for purpose, name, since_s in held
    ]
    at_ns = int((BEGAN_S + at_s) * S)
    return Message(LOCKS, at_ns, at_ns, encoded(Locks(locks=all_)))


def recording(path: Path, *others: Message, without: range = range(0), hz: int = 50, seconds: int = 10) -> Path:
    """The head and the arm, 50 times a second for 10 s but for some of these moments, and what else there is."""
    moments = [number for number in range(hz * seconds + 1) if number not in without]
    messages = [joints("rosie.head", HEAD, number / hz) for number in moments]
    messages += [joints("rosie.left.arm", ARM, number / hz + 0.007) for number in moments]
    with RecordingFile(path, {}) as file:
        for message in sorted([*messages, *others], key=lambda one: one.stamp_ns):
            file.write(message)
    return path


def export(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, words)])


def rows(folder: Path, name: str = "data") -> list[dict[str, Any]]:
    return parquet.read_table(folder / name / "chunk-000/file-000.parquet").to_pylist()


def test_a_whole_recording_is_one_episode_at_even_times(tmp_path: Path) -> None:
    file, folder = recording(tmp_path / "walk.mcap"), tmp_path / "set"
    done = export(file, folder, "--group", "rosie.head", "--fps", "30", "--json")
    assert done.exit_code == 0, done.output
    reported = json.loads(done.stdout)
    assert (reported["episodes"], reported["frames"], reported["joints"], reported["tasks"]) == (1, 300, HEAD, ["walk"])
    data = rows(folder)
    assert [row["frame_index"] for row in data] == [row["index"] for row in data] == list(range(300))
    assert [row["timestamp"] for row in data] == pytest.approx([number / 30 for number in range(300)])
    assert {(row["episode_index"], row["task_index"]) for row in data} == {(0, 0)}
    for row in data:
        assert row["observation.state"] == pytest.approx([angle(joint, row["timestamp"]) for joint in (0, 1)], abs=1e-5)


def test_the_action_is_the_state_of_the_next_frame(tmp_path: Path) -> None:
    export(recording(tmp_path / "walk.mcap"), tmp_path / "set", "--group", "rosie.head")
    data = rows(tmp_path / "set")
    assert all(before["action"] == after["observation.state"] for before, after in pairwise(data))
    assert data[-1]["action"][0] > data[-1]["observation.state"][0]


def test_joints_of_several_groups_are_in_one_frame_at_one_moment(tmp_path: Path) -> None:
    export(recording(tmp_path / "walk.mcap"), tmp_path / "set", "--fps", "10")
    data = rows(tmp_path / "set")
    [begins] = {round(row["observation.state"][0] / 0.1 - row["timestamp"], 3) for row in data}
    assert begins == 0.007  # when the last of them was measured first
    assert all(row["observation.state"][0] == pytest.approx(row["observation.state"][2], abs=1e-5) for row in data)


def test_the_time_of_each_lock_over_the_joints_is_an_episode_and_its_purpose_the_task(tmp_path: Path) -> None:
    own, other = "rosie.neck.pan", "rosie.legs.left.hip"
    said = [
        locks(0.0),
        locks(2.2, ("nod", own, 2.0)),
        locks(3.2, ("nod", own, 2.0), ("walk", other, 3.0)),
        locks(4.0, ("walk", other, 3.0)),
        locks(5.2, ("shake", own, 5.0), ("walk", other, 3.0)),
        locks(6.0),
        locks(8.1, ("nod", own, 8.0)),
        locks(9.0, ("nod", own, 8.95)),  # given back and taken again since the look before
    ]
    done = export(
        recording(tmp_path / "a.mcap", *said), tmp_path / "set", "--episodes", "locks", "--fps", "20", "--json"
    )
    assert json.loads(done.stdout)["tasks"] == ["nod", "shake", "nod", "nod"]
    found = rows(tmp_path / "set", "meta/episodes")
    assert [round(one["length"] / 20, 1) for one in found] == pytest.approx([2.0, 1.0, 0.9, 1.0], abs=0.11)
    assert [one["tasks"] for one in found] == [["nod"], ["shake"], ["nod"], ["nod"]]
    data = rows(tmp_path / "set")
    for one in found:
        part = data[one["dataset_from_index"] : one["dataset_to_index"]]
        assert {row["episode_index"] for row in part} == {one["episode_index"]}
        assert [row["frame_index"] for row in part] == list(range(one["length"]))
    assert data[0]["observation.state"][0] == pytest.approx(angle(0, 2.02), abs=0.003)
    assert [row["task_index"] for row in data if row["frame_index"] == 0] == [0, 1, 0, 0]
    assert parquet.ParquetFile(tmp_path / "set/data/chunk-000/file-000.parquet").num_row_groups == 4


def test_a_lock_over_two_containers_is_one_episode(tmp_path: Path) -> None:
    both = ("look", "rosie.neck.pan", 2.0), ("look", "rosie.left.arm", 2.01)
    said = [locks(0.0), locks(2.1, *both), locks(4.0, both[1]), locks(5.0)]
    done = export(recording(tmp_path / "a.mcap", *said), tmp_path / "set", "--episodes", "locks", "--json")
    assert json.loads(done.stdout)["tasks"] == ["look"]


def test_a_gap_costs_its_own_time_and_not_the_recording(tmp_path: Path) -> None:
    file = recording(tmp_path / "walk.mcap", without=range(100, 140))
    done = export(file, tmp_path / "set", "--fps", "50", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["tasks"] == ["walk", "walk"]
    said = " ".join(done.stderr.split())
    assert "walk is cut: rosie.neck.pan moved and was not measured from 2.0 to 2.8 s" in said
    assert "left out" not in said
    first, second = rows(tmp_path / "set", "meta/episodes")
    assert (first["length"] / 50, second["length"] / 50) == (pytest.approx(2.0, abs=0.1), pytest.approx(7.2, abs=0.1))
    data = rows(tmp_path / "set")
    assert max(row["observation.state"][0] for row in data if row["episode_index"] == 0) < angle(0, 2.0)
    assert min(row["observation.state"][0] for row in data if row["episode_index"] == 1) >= angle(0, 2.8)


def test_a_gap_of_one_joint_among_others_cuts_all(tmp_path: Path) -> None:
    moments = [number / 50 for number in range(501)]
    arm = [joints("rosie.left.arm", ARM, at_s) for at_s in moments if not 4.0 < at_s < 5.0]
    with RecordingFile(tmp_path / "walk.mcap", {}) as recorded:
        for message in sorted([*arm, *(joints("rosie.head", HEAD, at_s) for at_s in moments)], key=lambda one: one[2]):
            recorded.write(message)
    done = export(tmp_path / "walk.mcap", tmp_path / "set", "--fps", "50", "--json")
    assert done.exit_code == 0, done.output
    lengths = [one["length"] / 50 for one in rows(tmp_path / "set", "meta/episodes")]
    assert lengths == pytest.approx([4.0, 5.0], abs=0.1)


def test_a_lock_in_which_joints_moved_unmeasured_is_cut_and_reported(tmp_path: Path) -> None:
    said = [locks(1.0, ("a", HEAD[0], 1.0)), locks(3.0, ("b", HEAD[0], 3.0)), locks(7.0)]
    file = recording(tmp_path / "a.mcap", *said, without=range(75, 115))
    done = export(file, tmp_path / "set", "--episodes", "locks", "--task", "look", "--json")
    assert json.loads(done.stdout)["tasks"] == ["look", "look", "look"]
    said = " ".join(done.stderr.split())
    assert "look is cut: rosie.neck.pan moved and was not measured from 0.5 to 1.3 s" in said


def test_the_tables_are_laid_out_as_version_3_says(tmp_path: Path) -> None:
    export(recording(tmp_path / "walk.mcap"), tmp_path / "set", "--group", "rosie.head", "--task", "look about")
    files = {str(path.relative_to(tmp_path / "set")) for path in (tmp_path / "set").rglob("*") if path.is_file()}
    meta = {"meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"}
    assert files == {*meta, "data/chunk-000/file-000.parquet", "README.md"}
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["splits"]) == ("v3.0", 30, {"train": "0:1"})
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (1, 300, 1)
    assert info["data_path"].format(chunk_index=0, file_index=0) in files
    schema = parquet.read_schema(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert schema.names == list(info["features"])
    for name, reported in info["features"].items():
        kind = schema.field(name).type
        if reported["shape"] == [1]:
            assert str(kind) in {reported["dtype"], {"float32": "float"}.get(reported["dtype"])}
        else:
            assert (str(kind.value_type), [kind.list_size], reported["names"]) == ("float", reported["shape"], HEAD)
    tasks = parquet.read_table(tmp_path / "set/meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "look about"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    [episode] = rows(tmp_path / "set", "meta/episodes")
    assert all(episode[name] == 0 for name in episode if name.endswith("_index") and name != "dataset_to_index")


def test_the_statistics_for_normalisation_are_exported(tmp_path: Path) -> None:
    export(recording(tmp_path / "walk.mcap"), tmp_path / "set", "--group", "rosie.head")
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    for name in ("observation.state", "action"):
        for joint in (0, 1):
            values = [row[name][joint] for row in rows(tmp_path / "set")]
            mean = sum(values) / len(values)
            reported = {key: numbers[joint] for key, numbers in stats[name].items() if key != "count"}
            std = math.sqrt(sum((value - mean) ** 2 for value in values) / len(values))
            assert reported == pytest.approx(
                {"min": min(values), "max": max(values), "mean": mean, "std": std}, abs=1e-5
            )
        assert stats[name]["count"] == [300]


def test_a_folder_that_has_something_in_it_stays_as_it_is(tmp_path: Path) -> None:
    file, folder = recording(tmp_path / "walk.mcap"), tmp_path / "set"
    folder.mkdir()
    (folder / "precious").write_text("mine")
    refused = export(file, folder)
    assert isinstance(refused.exception, ConfigurationError)
    assert "is not empty" in str(refused.exception)
    assert [path.name for path in folder.iterdir()] == ["precious"]


def test_what_cannot_be_exported_is_named_and_nothing_is_made(tmp_path: Path) -> None:
    file, folder = recording(tmp_path / "walk.mcap", locks(1.0)), tmp_path / "set"
    no_group = export(file, folder, "--group", "rosie.tail").exception
    assert isinstance(no_group, UsageError)
    assert "it has rosie.head, rosie.left.arm" in str(no_group)
    no_lock = export(file, folder, "--episodes", "locks").exception
    assert "has no episode of rosie.head, rosie.left.arm: no lock over these joints was recorded" in str(no_lock)
    with RecordingFile(tmp_path / "empty.mcap", {}):
        pass
    assert "has no joints" in str(export(tmp_path / "empty.mcap", folder).exception)
    assert not folder.exists()
