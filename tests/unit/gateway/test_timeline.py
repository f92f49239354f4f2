"""The wall clock steps during a recording: durations and last positions are those of the monotonic clock."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from msgspec import Struct

from trade import Container, Resource, service, where
from trade.errors import ConfigurationError
from trade.testing import memory_system
from trade_gateway.recording._channels import JointStates
from trade_gateway.recording._episodes import Span, episodes, locked
from trade_gateway.recording._file import RecordingFile
from trade_gateway.recording._motion import motion_of, motions
from trade_gateway.recording._reader import entries
from trade_gateway.recording._recorder import Recorder
from trade_gateway.recording._sources import RecordedParts
from trade_gateway.recording._timeline import Timeline

pytestmark = pytest.mark.virtual_time

TURN_RAD_S = 0.05
LASTS_S, STEPS_AT_S = 10.0, 6.0


class State(Struct):
    name: str
    position_rad: float
    velocity_rad_s: float = TURN_RAD_S
    load: float = 0.0
    enabled: bool = True
    fault: str = ""
    age_s: float = 0.0


class Motor:
    """It turns evenly, by the monotonic clock."""

    resources = (Resource("rosie.neck"),)

    @service(effect="read")
    def state(self) -> State:
        return State("rosie.neck", TURN_RAD_S * time.monotonic())

    @service
    def move_to(self, position_rad: float) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...


class WallClock:
    """The wall clock of this computer, which is put to another time."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.off_ns = 0
        now_ns = time.time_ns
        patch.setattr(time, "time_ns", lambda: now_ns() + self.off_ns)
        patch.setattr(time, "time", lambda: (now_ns() + self.off_ns) / 1e9)

    def step(self, by_s: float) -> None:
        self.off_ns += round(by_s * 1e9)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> WallClock:
    return WallClock(monkeypatch)


def recorded(file: Path, wall: WallClock, by_s: float) -> None:
    """Ten seconds, with a lock from 2 to 8 s; the clock steps at 6 s."""
    with ExitStack() as undo:
        system = undo.enter_context(memory_system())
        robot, visitor = system.container("robot"), system.container("recorder")
        robot.register(Motor(), "rosie.neck")
        visitor.find(where(name="state"), wait_s=5)
        ending = threading.Event()
        recorder = undo.enter_context(Recorder(visitor, RecordedParts(), ending))
        recorder.look()
        stepping = threading.Thread(target=_events, args=(robot, wall, by_s), name="events")
        sink = undo.enter_context(RecordingFile(file, {}))
        stepping.start()
        recorder.run(sink, LASTS_S, lambda: None)
        stepping.join()


def _tell(span: Span, what: str) -> None:
    raise AssertionError(f"{span} {what}")


def _events(robot: Container, wall: WallClock, by_s: float) -> None:
    pause = threading.Event()
    pause.wait(2)
    with robot.lock(where(group="rosie.neck"), purpose="wipe"):
        pause.wait(STEPS_AT_S - 2)
        wall.step(by_s)
        pause.wait(2)


@pytest.mark.parametrize("by_s", [0.0, -3600.0, -2.0, 2.0, 3600.0])
def test_a_step_of_the_clock_is_in_no_motion_and_no_episode(tmp_path: Path, wall: WallClock, by_s: float) -> None:
    file = tmp_path / "turn.mcap"
    recorded(file, wall, by_s)
    [(group, states)] = motions(file).items()
    motion = motion_of(group, states)
    assert motion.duration_s == pytest.approx(LASTS_S, abs=0.2)
    [(times, angles)] = motion.tracks
    assert angles[-1] - angles[0] == pytest.approx(TURN_RAD_S * (times[-1] - times[0]), abs=1e-3)
    for (before_s, before), (after_s, after) in pairwise(zip(times, angles, strict=True)):
        assert after - before == pytest.approx(TURN_RAD_S * (after_s - before_s), abs=1e-3)
    [span] = locked(entries(file), motion.joints)
    assert (span.task, span.until_s - span.from_s) == ("wipe", pytest.approx(6.0, abs=0.5))
    assert span.from_s - motion.began_s == pytest.approx(2.0, abs=0.5)
    [episode] = episodes({group: states}, [Span("all")], 10, _tell)
    assert len(episode.states) == pytest.approx(10 * LASTS_S, abs=3)
    assert [entry.arrived_ns for entry in entries(file)] == sorted(entry.arrived_ns for entry in entries(file))


def test_a_clock_before_1970_gives_a_recording_with_times_that_files_can_hold(tmp_path: Path, wall: WallClock) -> None:
    wall.step(-1e9 - time.time())
    file = tmp_path / "turn.mcap"
    recorded(file, wall, 0.0)
    [(group, states)] = motions(file).items()
    assert motion_of(group, states).duration_s == pytest.approx(LASTS_S, abs=0.2)
    assert min(stamp_s for one in states for stamp_s in one.stamp_s) > 0


def test_a_source_whose_clock_is_wrong_is_placed_where_it_arrives_and_stays_even() -> None:
    timeline = Timeline()
    now_s = timeline.now_s()
    assert timeline.placed("pi", 1000.0, 5 * 10**9) == pytest.approx(now_s, abs=0.1)
    corrected = [timeline.placed("pi", now_s + 2 + number, (6 + number) * 10**9) for number in range(3)]
    assert [after - before for before, after in pairwise(corrected)] == pytest.approx([1.0, 1.0])
    assert corrected[0] == pytest.approx(now_s + 1, abs=0.1)
    assert timeline.placed("laptop", now_s - 0.25, 10**15) == pytest.approx(now_s - 0.25, abs=0.01)


def test_a_source_whose_monotonic_clock_restarts_is_placed_again() -> None:
    timeline = Timeline()
    timeline.placed("pi", timeline.now_s(), 10**15)
    assert timeline.placed("pi", timeline.now_s(), 10**9) == pytest.approx(timeline.now_s(), abs=0.1)


def test_an_interruption_between_two_clocks_places_no_later_sample_after_it_arrived(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    timeline, wall_ns = Timeline(), time.time_ns

    def interrupted() -> int:
        read_ns = wall_ns()
        time.sleep(0.01)
        return read_ns

    with monkeypatch.context() as patch:
        patch.setattr(time, "time_ns", interrupted)
        timeline.placed("pi", time.time(), time.monotonic_ns())
    at, at_ns = time.time(), time.monotonic_ns()
    assert timeline.placed("pi", at, at_ns) <= timeline.now_s()


def _states(*stamps_s: float) -> Iterator[JointStates]:
    for number, stamp_s in enumerate(stamps_s):
        lists: dict[str, Any] = {"velocity_rad_s": [0.0], "load": [0.0], "enabled": [True], "fault": [""]}
        yield JointStates(names=["rosie.neck"], position_rad=[0.1 * number], stamp_s=[stamp_s], **lists)


def test_a_recording_of_before_with_a_step_back_in_it_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"rosie\.neck was measured at 98\.\d+ s after 100\.\d+ s.*set back"):
        motion_of("rosie", _states(100.0, 100.1, 100.2, 98.3, 98.4))
    assert motion_of("rosie", _states(100.0, 100.1, 100.2, 100.15, 100.3)).duration_s == pytest.approx(0.3)
