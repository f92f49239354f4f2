"""The byte log and the questions asked of it."""

from pathlib import Path

import pytest

from trade_hil_sim import ByteLog, LogEntry, events, instructions, motion_writes, read_log, received, sent, writes

pytestmark = pytest.mark.virtual_time

STORY = [
    LogEntry(1.0, "neck", "received", hex="0102"),
    LogEntry(1.0, "neck", "instruction", "sync_read", 254, (1, 2), address=132),
    LogEntry(1.1, "neck", "sent", "sync_read", 1, hex="aa"),
    LogEntry(2.0, "neck", "instruction", "write", 1, address=64, hex="01", registers=("torque_enable",), moves=True),
    LogEntry(2.1, "neck", "event", "torque_on", 1, joint="neck.pan", position_counts=2048, position_rad=0.0),
    LogEntry(3.0, "neck", "instruction", "write", 2, address=98, hex="0f", registers=("bus_watchdog",)),
    LogEntry(4.0, "neck", "instruction", "write", 254, address=116, registers=("goal_position",), moves=True),
    LogEntry(5.0, "arm", "instruction", "ping", 254),
    LogEntry(6.0, "arm", "event", "at_rest", 3, position_counts=7),
]


def test_a_log_file_gives_back_what_was_put_in(tmp_path: Path) -> None:
    with ByteLog(tmp_path / "log") as log:
        for entry in STORY:
            log.add(entry)
        assert read_log(tmp_path / "log") == STORY  # before it is closed: nothing is held back
        assert log.entries == []
    assert STORY[0].data == b"\x01\x02"


def test_a_log_is_appended_to(tmp_path: Path) -> None:
    for entry in STORY[:2]:
        with ByteLog(tmp_path / "log", keep=True) as log:
            log.add(entry)
            assert log.entries == [entry]
    assert read_log(tmp_path / "log") == STORY[:2]


def test_a_line_half_written_is_left_for_later(tmp_path: Path) -> None:
    with ByteLog(tmp_path / "log") as log:
        log.add(STORY[0])
    with (tmp_path / "log").open("ab") as file:
        file.write(b'{"t":2.0,"bus"')
    assert read_log(tmp_path / "log") == STORY[:1]
    (tmp_path / "empty").touch()
    assert read_log(tmp_path / "empty") == []


def test_bytes_are_shown_by_direction_time_and_bus() -> None:
    assert received(STORY) == b"\x01\x02"
    assert received(STORY, bus="arm") == b""
    assert sent(STORY, since=1.05, until=1.15) == b"\xaa"


def test_a_broadcast_instruction_reaches_all_and_a_group_read_the_named_servos() -> None:
    assert [e.t for e in instructions(STORY, device_id=1)] == [1.0, 2.0, 4.0, 5.0]
    assert [e.t for e in instructions(STORY, device_id=3)] == [4.0, 5.0]
    assert [e.t for e in instructions(STORY, "ping")] == [5.0]


def test_motion_writes_are_the_writes_that_could_move_something() -> None:
    assert [e.t for e in writes(STORY)] == [2.0, 3.0, 4.0]
    assert [e.t for e in motion_writes(STORY)] == [2.0, 4.0]
    assert [e.t for e in motion_writes(STORY, device_id=2, since=2.5)] == [4.0]
    assert [e.t for e in writes(STORY, register="bus_watchdog")] == [3.0]


def test_events_are_reported_by_name_and_device() -> None:
    assert [e.name for e in events(STORY)] == ["torque_on", "at_rest"]
    assert [e.position_counts for e in events(STORY, "at_rest", device_id=3)] == [7]
