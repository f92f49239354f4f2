"""Files of recordings: what is in them, whatever ends them; the seconds that are kept for a fault."""

import json
from collections.abc import Iterator
from pathlib import Path

import jsonschema_rs
import pytest
from mcap.reader import NonSeekingReader, make_reader
from msgspec import Struct
from msgspec import json as as_json

from tests.support.full_disks import FullDisk
from trade.errors import ConfigurationError
from trade_gateway.recording._channels import (
    FAULTS,
    LOCKS,
    Channel,
    Fault,
    FaultKind,
    JointStates,
    Lock,
    Locks,
    Message,
    encoded,
    group_of,
    inlined,
    joints_channel,
    picture,
    service_channel,
)
from trade_gateway.recording._fault_trigger import HOLD_OFF_S, SavedAtFault
from trade_gateway.recording._file import RecordingFile
from trade_gateway.recording._reader import entries
from trade_gateway.recording._recorder import Ring
from trade_gateway.recording._sources import within

S = 1_000_000_000


def joints(at_s: float, position_rad: float = 0.0) -> Message:
    states = JointStates(
        names=["rosie.neck.pan"],
        position_rad=[position_rad],
        velocity_rad_s=[0.0],
        load=[0.0],
        enabled=[True],
        fault=[""],
        stamp_s=[at_s],
    )
    return Message(joints_channel("rosie.head"), int(at_s * S) + 5, int(at_s * S), encoded(states))


def fault(at_s: float, text: str = "hot", *, kind: FaultKind = "health", new: bool = True) -> Message:
    about = Fault(about="rosie.neck", kind=kind, text=text, new=new)
    return Message(FAULTS, int(at_s * S), int(at_s * S), encoded(about))


def test_any_reader_finds_messages_times_metadata_and_robot_files(tmp_path: Path) -> None:
    with RecordingFile(tmp_path / "a.mcap", {"system": "lab"}, [("head.toml", b"[robot]")]) as file:
        file.write(joints(1))
        file.write(joints(2, 0.5))
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream)
        found = [(channel.topic, message) for _, channel, message in reader.iter_messages()]
        assert [topic for topic, _ in found] == ["/rosie.head/joints"] * 2
        assert [(message.log_time, message.publish_time) for _, message in found] == [(S + 5, S), (2 * S + 5, 2 * S)]
        assert [metadata.metadata for metadata in reader.iter_metadata()] == [{"system": "lab"}]
        assert [(one.name, one.data) for one in reader.iter_attachments()] == [("head.toml", b"[robot]")]


LOCK = Lock(container="c", resources=["rosie.neck"], owner="me/c", purpose="look", since_s=1.0, waiting=[])
EXAMPLES = [
    joints(1),
    fault(1),
    Message(LOCKS, S, S, encoded(Locks(locks=[LOCK]))),
    picture("rosie.eye", b"\x89PNG", "png", 4, 3, S + 7),
    picture("rosie.eye", bytes(36), "rgb8", 4, 3, S + 7),
]


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: message.channel.schema_name)
def test_messages_are_as_their_schemas_say_and_those_do_not_hold_for_anything(message: Message) -> None:
    schema = json.loads(message.channel.schema)
    value = json.loads(message.data)
    assert schema["type"] == "object"
    assert "$ref" not in message.channel.schema.decode()
    jsonschema_rs.validate(schema, value)
    for name in schema["required"]:
        with pytest.raises(jsonschema_rs.ValidationError):
            jsonschema_rs.validate(schema, {**value, name: {"other": 1}} if name != "timestamp" else {})


def test_pictures_are_named_and_laid_out_as_viewers_know_them() -> None:
    file, raw = EXAMPLES[3], EXAMPLES[4]
    assert (file.channel.topic, file.channel.schema_name) == ("/cameras/rosie.eye", "foxglove.CompressedImage")
    assert json.loads(file.data)["timestamp"] == {"sec": 1, "nsec": 7}
    assert (raw.channel.schema_name, json.loads(raw.data)["step"]) == ("foxglove.RawImage", 12)


class Tree(Struct):
    name: str
    branches: list["Tree"]


def test_a_schema_refers_to_nothing_even_if_a_type_contains_itself() -> None:
    schema = inlined(as_json.schema(Tree))
    assert schema["properties"]["branches"]["items"] == {}
    channel = service_channel("rosie.tree.grow", {"type": "array", "items": {"type": "number"}})
    jsonschema_rs.validate(json.loads(channel.schema), {"value": [1.5]})
    with pytest.raises(jsonschema_rs.ValidationError):
        jsonschema_rs.validate(json.loads(channel.schema), {"value": ["far"]})


def test_topics_of_joints_name_their_group() -> None:
    assert group_of(joints_channel("rosie.head").topic) == "rosie.head"
    assert group_of("/calls") is None


def test_groups_are_whole_segments() -> None:
    assert within("rosie.head.state", ["rosie.head"])
    assert not within("rosie.heads.state", ["rosie.head"])
    assert within("anything", [])


def test_flushed_records_are_present_though_the_writer_never_ended_properly(tmp_path: Path) -> None:
    file = RecordingFile(tmp_path / "a.mcap", {})
    for second in range(5):
        file.write(joints(second))
    file.flush()
    file.write(joints(5))
    copy = tmp_path / "killed.mcap"
    copy.write_bytes((tmp_path / "a.mcap").read_bytes())
    file.close()
    assert [entry.stamp_ns // S for entry in entries(copy)] == [0, 1, 2, 3, 4]
    assert [entry.stamp_ns // S for entry in entries(tmp_path / "a.mcap")] == [0, 1, 2, 3, 4, 5]


def test_wherever_a_file_is_cut_off_all_before_the_last_whole_chunk_is_read(tmp_path: Path) -> None:
    file = RecordingFile(tmp_path / "a.mcap", {})
    ends: list[int] = []
    for second in range(3):
        file.write(joints(second))
        file.flush()
        ends.append(file.size_bytes)
    whole = (tmp_path / "a.mcap").read_bytes()
    file.close()
    cut = tmp_path / "cut.mcap"
    for length in range(ends[0], len(whole)):
        cut.write_bytes(whole[:length])
        least = sum(end <= length for end in ends)
        assert len(list(entries(cut))) in (least, least + 1)  # its index may be missing, and not be missed


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("hello, this is a text")
    with pytest.raises(ConfigurationError, match="is not a recording"):
        list(entries(tmp_path / "a.mcap"))
    with pytest.raises(ConfigurationError, match="cannot be read: No such file"):
        list(entries(tmp_path / "b.mcap"))


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("precious")
    with pytest.raises(ConfigurationError, match="File exists"):
        RecordingFile(tmp_path / "a.mcap", {})
    assert (tmp_path / "a.mcap").read_text() == "precious"


def test_on_a_full_disk_the_file_ends_with_its_last_whole_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    file = RecordingFile(path, {}, opened=lambda there: FullDisk(there, 4000))
    flushed = 0
    with pytest.raises(OSError, match="No space left"):
        for second in range(1000):
            file.write(joints(second))
            file.flush()
            flushed = second + 1
    file.close()
    assert flushed > 1
    with path.open("rb") as stream:
        found = list(make_reader(stream).iter_messages())
    assert len(found) == flushed
    assert path.read_bytes()[-8:] == b"\x89MCAP0\r\n"
    with path.open("rb") as stream:
        assert len(list(NonSeekingReader(stream, validate_crcs=True).iter_messages())) == flushed


def test_the_ring_drops_what_is_too_old() -> None:
    ring = Ring(3, 1_000_000)
    for second in range(10):
        ring.write(joints(second))
    assert ring.cut_short == 0
    assert ring.size_bytes == sum(len(joints(second).data) for second in (6, 7, 8, 9))


def test_the_ring_never_takes_more_memory_than_it_was_given() -> None:
    size = len(joints(0).data)
    ring = Ring(1000, 10 * size)
    for second in range(50):
        ring.write(joints(0)._replace(arrived_ns=second * S))
        assert ring.size_bytes <= 10 * size
    assert ring.cut_short == 40


class Kept:
    """A folder, and the reports about it; time passes only when the test advances it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now = 100.0
        self.saved: list[tuple[Path, str, int]] = []
        self.problems: list[str] = []
        self.sink = SavedAtFault(
            folder,
            Ring(30, 1_000_000),
            {},
            [],
            lambda *reported: self.saved.append(reported),
            self.problems.append,
            self.clock,
        )

    def clock(self) -> float:
        return self.now


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Kept]:
    yield Kept(tmp_path / "faults")


def test_a_fault_saves_what_came_before_it_and_says_why(kept: Kept) -> None:
    for second in range(100):
        kept.sink.write(joints(second))
    kept.sink.write(fault(99, "pan is hot"))
    [(path, why, count)] = kept.saved
    assert (why, count) == ("rosie.neck: pan is hot", 32)
    assert [entry.stamp_ns // S for entry in entries(path)] == [*range(69, 100), 99]
    with path.open("rb") as stream:
        assert next(iter(make_reader(stream).iter_metadata())).metadata == {"fault": why}


def test_a_further_fault_right_after_is_the_same_event(kept: Kept) -> None:
    kept.sink.write(fault(1))
    kept.now += HOLD_OFF_S / 2
    kept.sink.write(fault(2, "stopped", kind="e-stop"))
    assert len(kept.saved) == 1
    kept.now += HOLD_OFF_S
    kept.sink.write(fault(3, "stopped", kind="e-stop"))
    assert [count for *_, count in kept.saved] == [1, 3]


@pytest.mark.parametrize("message", [fault(1, ""), fault(1, new=False), fault(1, kind="gone"), joints(1)])
def test_only_a_fault_saves_a_recording(kept: Kept, message: Message) -> None:
    kept.sink.write(message)
    assert kept.saved == []


def test_state_that_could_not_be_saved_is_reported_and_kept_for_the_next_event(kept: Kept) -> None:
    kept.sink.write(joints(0))
    kept.folder.rmdir()
    kept.sink.write(fault(1))
    assert len(kept.problems) == 1
    kept.folder.mkdir()
    kept.now += HOLD_OFF_S
    kept.sink.write(fault(2))
    assert [count for *_, count in kept.saved] == [3]


def test_a_long_channel_list_is_still_one_schema_a_topic(tmp_path: Path) -> None:
    other = Channel("/other", "other", b'{"type":"object"}')
    with RecordingFile(tmp_path / "a.mcap", {}) as file:
        for _ in range(3):
            file.write(joints(1))
            file.write(Message(other, 1, 1, b"{}"))
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert sorted(channel.topic for channel in summary.channels.values()) == ["/other", "/rosie.head/joints"]
    assert len(summary.schemas) == 2
