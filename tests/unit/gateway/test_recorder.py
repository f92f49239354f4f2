"""A recording under way, in one process: its streams, and what it records of calls, locks, health and e-stops."""

import json
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
from mcap.reader import make_reader
from msgspec import Struct
from typer.testing import CliRunner

from tests.support.full_disks import FullDisk
from tests.support.waiting import PATIENCE_S, wait_until
from trade import Container, Resource, Secret, service, where
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.recording._channels import Message
from trade_gateway.recording._file import RecordingFile
from trade_gateway.recording._recorder import Recorder
from trade_gateway.recording._sources import RecordedParts
from trade_gateway.recording.commands import _progress

pytestmark = pytest.mark.virtual_time


class State(Struct):
    name: str
    position_rad: float = 0.25
    velocity_rad_s: float = 0.0
    load: float = 0.0
    enabled: bool = True
    fault: str = ""
    age_s: float = 0.5


class Image(Struct):
    data: bytes = b"\x89PNG"
    format: str = "png"
    width_px: int = 2
    height_px: int = 1
    age_s: float = 0.0


class Motor:
    def __init__(self, name: str) -> None:
        self.name = name
        self.resources = (Resource(name),)
        self.sick = False
        self.fault = ""

    @service(effect="read")
    def state(self) -> State:
        if self.sick:
            raise ValueError("no answer")
        return State(self.name, fault=self.fault)

    @service
    def move_to(self, position_rad: float, word: Secret[str] = "") -> float:
        if position_rad > 1:
            raise ValueError("too far")
        return position_rad

    @service(effect="stop")
    def stop(self) -> None: ...


class JointGroup:
    def __init__(self, *motors: Motor) -> None:
        self.motors = motors
        self.resources = tuple(resource for motor in motors for resource in motor.resources)

    @service(effect="read")
    def state(self) -> list[State]:
        return [motor.state() for motor in self.motors]

    @service
    def move_to(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...


class Camera:
    @service(effect="read")
    def image(self) -> Image:
        return Image()


class Seen(Exception):
    """All that was waited for has come."""


class Sink:
    """Ends the recording once it has seen what was wanted."""

    def __init__(self) -> None:
        self.by_topic: dict[str, list[Any]] = defaultdict(list)
        self.messages: list[Message] = []
        self.enough: Callable[[Sink], bool] = lambda _: False

    def write(self, message: Message) -> None:
        self.messages.append(message)
        self.by_topic[message.channel.topic].append(json.loads(message.data))
        if self.enough(self):
            raise Seen


Record = Callable[[Callable[[Sink], bool]], Sink]


@pytest.fixture
def robot(start_container: Callable[..., Container]) -> Container:
    return start_container("robot")


@pytest.fixture
def pan() -> Motor:
    return Motor("rosie.neck.pan")


@pytest.fixture
def head(robot: Container, pan: Motor) -> JointGroup:
    group = JointGroup(pan)
    robot.register(pan, "rosie.neck.pan")
    robot.register(group, "rosie.head")
    robot.register(Motor("rosie.elbow"), "rosie.elbow")
    robot.register(Camera(), "rosie.eye")
    return group


@pytest.fixture
def recorder(start_container: Callable[..., Container], head: JointGroup) -> Iterator[Recorder]:
    container = start_container("recorder")
    container.find(where(name="image"), wait_s=PATIENCE_S)
    with Recorder(
        container, RecordedParts(groups=["rosie"], services=["rosie.elbow.st?te"]), threading.Event()
    ) as made:
        yield made


@pytest.fixture
def record(recorder: Recorder) -> Record:
    sink = Sink()

    def until(enough: Callable[[Sink], bool]) -> Sink:
        sink.enough = enough
        with pytest.raises(Seen):
            recorder.run(sink, PATIENCE_S, lambda: None)
        return sink

    return until


def test_each_joint_is_recorded_once_with_the_group_it_belongs_to(recorder: Recorder, record: Record) -> None:
    assert recorder.look() == ["rosie.elbow.state", "rosie.eye.image", "rosie.head.state"]
    seen = record(lambda sink: {"/rosie.head/joints", "/rosie.elbow/joints", "/cameras/rosie.eye"} <= {*sink.by_topic})
    assert seen.by_topic["/rosie.head/joints"][0]["position_rad"] == [0.25]
    assert seen.by_topic["/rosie.elbow/joints"][0]["names"] == ["rosie.elbow"]
    assert "/rosie.neck.pan/joints" not in seen.by_topic


def test_the_stamp_of_joints_is_when_they_were_measured(record: Record) -> None:
    seen = record(lambda sink: "/rosie.head/joints" in sink.by_topic)
    message = next(one for one in seen.messages if one.channel.topic == "/rosie.head/joints")
    assert json.loads(message.data)["stamp_s"] == [pytest.approx(message.stamp_ns / 1e9)]
    assert message.arrived_ns - message.stamp_ns >= 500_000_000


def test_what_arrived_later_is_later_in_the_file_also_when_the_clock_is_put_back(
    record: Record, robot: Container, monkeypatch: pytest.MonkeyPatch
) -> None:
    right_ns = time.time_ns
    first = record(lambda sink: {"/rosie.head/joints", "/locks"} <= {*sink.by_topic}).messages[-1]
    monkeypatch.setattr(time, "time_ns", lambda: right_ns() - 3600 * 10**9)
    with robot.lock(where(group="rosie.neck.pan")):
        seen = record(lambda sink: any(lock["locks"] for lock in sink.by_topic["/locks"]))
        times = [one.arrived_ns for one in seen.messages]
        assert times == sorted(times)
        assert times[-1] > first.arrived_ns
        assert len(set(times)) > len(times) / 2


def _move(container: Container, *args: object) -> None:
    container.find(where(name="move_to", group="rosie.neck.pan"), wait_s=PATIENCE_S)(*args)


def test_calls_are_reported_without_arguments_and_samples_are_no_calls(record: Record, robot: Container) -> None:
    record(lambda sink: robot._parts.caller.spans is not None)
    _move(robot, 0.5, "swordfish")
    with pytest.raises(ValueError, match="too far"):
        _move(robot, 1.5)
    seen = record(lambda sink: len(sink.by_topic["/calls"]) == 2)
    calls = seen.by_topic["/calls"]
    assert [(call["service"], call["outcome"]) for call in calls] == [
        ("rosie.neck.pan.move_to", "ok"),
        ("rosie.neck.pan.move_to", "ValueError"),
    ]
    assert not any(b"swordfish" in message.data for message in seen.messages)


def test_calls_are_noted_only_while_one_records(record: Record, recorder: Recorder, robot: Container) -> None:
    record(lambda sink: robot._parts.caller.spans is not None)
    recorder.close()
    assert robot._parts.caller.spans is None


def test_a_client_that_traced_calls_before_continues(
    robot: Container, head: JointGroup, start_container: Callable[..., Container]
) -> None:
    robot.set_tracing(True, container="robot")
    _move(robot, 0.1)
    container = start_container("recorder")
    container.find(where(name="image"), wait_s=PATIENCE_S)
    sink = Sink()
    sink.enough = lambda sink: bool(sink.by_topic["/calls"])
    with Recorder(container, RecordedParts(), threading.Event()) as recorder:
        began = threading.Thread(target=lambda: [_move(robot, 0.2) for _ in range(3)])
        # What was noted before is not of this recording: its own thread has to have read that.
        wait_until(lambda: recorder._watch._calls._read)
        began.start()
        with pytest.raises(Seen):
            recorder.run(sink, PATIENCE_S, lambda: None)
        began.join(PATIENCE_S)
    assert len(sink.by_topic["/calls"]) <= 3
    assert robot._parts.caller.spans is not None


def test_locks_are_sent_whenever_they_change(record: Record, robot: Container) -> None:
    record(lambda sink: sink.by_topic["/locks"] == [{"locks": []}])
    with robot.lock(where(group="rosie.neck.pan"), purpose="look"):
        seen = record(lambda sink: bool(sink.by_topic["/locks"][-1]["locks"]))
    [lock] = seen.by_topic["/locks"][-1]["locks"]
    assert (lock["purpose"], lock["resources"]) == ("look", ["rosie.neck.pan"])
    record(lambda sink: not sink.by_topic["/locks"][-1]["locks"])


def test_changes_of_health_and_e_stops_are_reported_with_their_ends(
    record: Record, robot: Container, pan: Motor
) -> None:
    record(lambda sink: bool(sink.by_topic["/locks"]))
    robot.set_health(pan, "hot")
    record(lambda sink: [fault["text"] for fault in sink.by_topic["/faults"]] == ["hot"])
    robot.set_health(pan, "healthy")
    estop = robot.estop("smoke")
    seen = record(lambda sink: any("smoke" in fault["text"] for fault in sink.by_topic["/faults"]))
    assert all(fault["new"] for fault in seen.by_topic["/faults"])
    robot.estop_clear([one.id for one in robot.estops()])
    ends = lambda sink: {fault["about"] for fault in sink.by_topic["/faults"] if not fault["text"]}  # noqa: E731
    record(lambda sink: len(ends(sink)) == 2)
    assert estop is not None


def test_a_service_that_fails_is_reported_once_until_it_answers_again(record: Record, pan: Motor) -> None:
    record(lambda sink: bool(sink.by_topic["/rosie.head/joints"]))
    pan.sick = True
    seen = record(lambda sink: bool(sink.by_topic["/faults"]))
    pan.sick = False
    record(lambda sink: len(sink.by_topic["/faults"]) == 2)
    assert [(fault["kind"], fault["text"]) for fault in seen.by_topic["/faults"]] == [
        ("unreadable", "ValueError: no answer"),
        ("unreadable", ""),
    ]


def test_the_fault_of_a_joint_is_reported_once_and_so_is_its_end(record: Record, pan: Motor) -> None:
    record(lambda sink: bool(sink.by_topic["/rosie.head/joints"]))
    pan.fault = "hot"
    seen = record(lambda sink: sink.by_topic["/rosie.head/joints"][-1]["fault"] == ["hot"])
    pan.fault = ""
    record(lambda sink: len(sink.by_topic["/faults"]) == 2)
    assert [(fault["about"], fault["kind"], fault["text"]) for fault in seen.by_topic["/faults"]] == [
        ("rosie.neck.pan", "joint", "hot"),
        ("rosie.neck.pan", "joint", ""),
    ]


def test_a_provider_that_leaves_and_comes_back_is_recorded_again(
    record: Record, robot: Container, head: JointGroup
) -> None:
    record(lambda sink: bool(sink.by_topic["/rosie.head/joints"]))
    robot.deregister(head)
    seen = record(lambda sink: any(fault["kind"] == "gone" for fault in sink.by_topic["/faults"]))
    count = len(seen.by_topic["/rosie.head/joints"])
    robot.register(head, "rosie.head")
    record(lambda sink: len(sink.by_topic["/rosie.head/joints"]) > count)


def _lines(*words: str) -> tuple[int, list[Any], str]:
    done = CliRunner().invoke(app, ["record", *words, "--json"])
    return done.exit_code, [json.loads(line) for line in done.stdout.splitlines()], done.stderr + str(done.exception)


@pytest.mark.usefixtures("head")
def test_the_command_says_what_it_records_how_far_it_is_and_what_there_is(tmp_path: Path) -> None:
    file = tmp_path / "a.mcap"
    (tmp_path / "rosie.toml").write_text("[robot]")
    code, said, _ = _lines(str(file), "--seconds", "2", "--attach", str(tmp_path / "rosie.toml"))
    assert code == 0
    assert said[0]["recording"] == said[-1]["recorded"] == str(file)
    assert "messages" in said[1]
    assert said[-1]["bytes"] == file.stat().st_size
    with file.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == said[-1]["messages"] > 0
        assert [one.name for one in reader.iter_attachments()] == ["rosie.toml"]
        for schema, _, message in reader.iter_messages():
            assert schema is not None
            jsonschema_rs.validate(json.loads(schema.data), json.loads(message.data))


@pytest.mark.usefixtures("head")
def test_a_full_disk_is_reported_with_an_exit_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_progress, "RecordingFile", partial(RecordingFile, opened=lambda path: FullDisk(path, 15_000)))
    file = tmp_path / "a.mcap"
    code, _, errors = _lines(str(file), "--seconds", str(PATIENCE_S), "--camera-hz", "100")
    assert code == 1
    assert "No space left on device; the file ends here and is readable" in errors
    with file.open("rb") as stream:
        assert any(make_reader(stream).iter_messages())


@pytest.mark.parametrize(
    "words", [[], ["a.mcap", "--at-fault", "there"], ["--at-fault", "there"], ["a.mcap", "--keep-last", "30"]]
)
def test_a_recording_goes_to_a_file_or_is_kept_for_a_fault(words: list[str]) -> None:
    done = CliRunner().invoke(app, ["record", *words])
    assert isinstance(done.exception, UsageError)
    assert "OUT.mcap, or --keep-last 30 --at-fault FOLDER" in str(done.exception)


def test_without_its_library_the_commands_say_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mcap", None)
    done = CliRunner().invoke(app, ["record", "a.mcap"])
    assert 'needs mcap. Run `pip install "trade-gateway[record]"`' in str(done.exception)
