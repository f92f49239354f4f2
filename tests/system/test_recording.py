"""A robot's recording: killed, at a fault of its simulation, and replayed in another one."""

import json
import math
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from itertools import dropwhile
from pathlib import Path

import pytest

import trade
from tests.support.foxglove_viewer import UNKNOWN, viewer
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import ROOT, ROSIES_HEAD, Bench, Program, Rosie
from trade import where
from trade_gateway.recording._motion import Motion, Track, deviation, motion_of, motions, moving
from trade_gateway.recording._reader import entries
from trade_hil_sim import SimControl, events, motion_writes, read_log


def test_a_recording_whose_program_was_killed_is_readable_to_its_last_second(
    rosie_up: Callable[[], Rosie], run: Callable[..., Program], tmp_path: Path
) -> None:
    rosie_up()
    file = tmp_path / "a.mcap"
    recording = run("-m", "trade_gateway", "record", file, "--json")
    flushed = recording.wait_for(lambda line: line.get("messages", 0) > 50)
    recording.signal(signal.SIGKILL)
    assert recording.wait() == -signal.SIGKILL
    found = list(entries(file))
    assert len(found) >= flushed["messages"]
    assert {"/rosie.head/joints"} <= {entry.topic for entry in found}


def test_a_fault_in_the_simulator_saves_the_seconds_before_it(
    bench: Bench, run: Callable[..., Program], tmp_path: Path
) -> None:
    folder = tmp_path / "faults"
    recording = run("-m", "trade_gateway", "record", "--keep-last", "30", "--at-fault", folder, "--json")
    recording.wait_for(lambda line: line.get("messages", 0) > 100)
    bench.sim.control.unplug("neck")
    saved = recording.wait_for(lambda line: "saved" in line)
    assert saved["messages"] > 50
    found = list(entries(Path(saved["saved"])))
    assert len([entry for entry in found if entry.topic == "/rosie.head/joints"]) > 50
    fault = json.loads(found[-1].data)
    assert found[-1].topic == "/faults"
    assert fault["new"]
    assert saved["why"] == f"{fault['about']}: {fault['text']}"


WAY = ([0.5, -0.3], [-0.6, 0.3], [0.2, 0.1], [0.0, 0.0])
TOLERANCE_RAD = 0.1
ARM = ROOT / "examples" / "arm.toml"
HOME = (0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0)
WAVES = ((0.5, -1.3), (-0.3, -1.6), (0.2, -1.4), HOME[:2])
"""Of the base and the shoulder of the arm; the other joints stay at home."""


@pytest.fixture
def recorded(rosie_up: Callable[[], Rosie], run: Callable[..., Program], tmp_path: Path) -> tuple[Path, Path]:
    """A recording of rosie's head, and the log of the simulation that it looked about in; both have ended."""
    rosie = rosie_up()
    file = tmp_path / "look.mcap"
    recording = run("-m", "trade_gateway", "record", file, "--group", "rosie.head", "--json")
    recording.wait_for(lambda line: line.get("messages", 0) > 20)
    look = trade.find(where(name="move_to", group="rosie.head"), wait_s=PATIENCE_S)
    for place in WAY:
        look(place, 1.5)
        threading.Event().wait(0.5)  # it rests there for a moment
    recording.signal(signal.SIGINT)
    assert recording.wait() == 0
    rosie.program.close()
    wait_until(lambda: not trade.services(where(group="rosie")))
    return file, rosie.log


def _rests(log: Path, joint: str) -> list[float]:
    return [entry.position_rad or 0.0 for entry in events(read_log(log), "at_rest") if entry.joint == joint]


def _in_order(wanted: Sequence[float], found: Sequence[float]) -> bool:
    """Whether one after the other is among those found, within the tolerance, whatever is in between."""
    left = iter(found)
    return all(any(abs(other - each) <= TOLERANCE_RAD for other in left) for each in wanted)


def test_a_replay_in_a_second_simulation_goes_where_the_first_one_went(
    recorded: tuple[Path, Path],
    rosie_up: Callable[[], Rosie],
    trade_command: Callable[..., subprocess.CompletedProcess[str]],
) -> None:
    file, first = recorded
    second = rosie_up()
    done = trade_command("replay", file, "--speed", "0.5", "--tolerance-rad", str(TOLERANCE_RAD), "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["greatest_rad"] <= TOLERANCE_RAD
    for number, joint in enumerate(("neck.pan", "neck.tilt")):
        went = _rests(first, joint)
        assert _in_order([place[number] for place in WAY], went)
        assert _in_order(went, _rests(second.log, joint))


def test_what_the_robot_file_forbids_is_refused_before_anything_moves(
    recorded: tuple[Path, Path],
    run: Callable[..., Program],
    trade_command: Callable[..., subprocess.CompletedProcess[str]],
    tmp_path: Path,
) -> None:
    narrow = tmp_path / "head.toml"
    narrow.write_text(ROSIES_HEAD.read_text(encoding="utf-8").replace("max_rad = 1.4", "max_rad = 0.4"))
    log = tmp_path / "narrow.jsonl"
    run("-m", "trade_gateway", "up", narrow, "--sim", "--sim-log", log, "--json").json()
    done = trade_command("replay", recorded[0], "--go-to-start")
    assert done.returncode == 1
    assert "LimitExceeded: rosie.neck.pan angle" in done.stderr
    assert motion_writes(read_log(log)) == []


def test_a_replay_far_from_its_start_moves_only_with_go_to_start(
    recorded: tuple[Path, Path],
    rosie_up: Callable[[], Rosie],
    trade_command: Callable[..., subprocess.CompletedProcess[str]],
) -> None:
    log = rosie_up().log
    trade.find(where(name="move_to", group="rosie.head"), wait_s=PATIENCE_S)([-0.5, 0.0])
    count = len(motion_writes(read_log(log)))
    refused = trade_command("replay", recorded[0], "--speed", "0.5")
    assert refused.returncode == 1
    assert "rosie.neck.pan is -0.50 rad off; --go-to-start moves it there first" in " ".join(refused.stderr.split())
    assert len(motion_writes(read_log(log))) == count
    checked = trade_command("replay", recorded[0], "--speed", "0.5", "--go-to-start", "--dry-run")
    assert checked.returncode == 0, checked.stderr
    assert len(motion_writes(read_log(log))) == count
    done = trade_command("replay", recorded[0], "--speed", "0.5", "--go-to-start", "--json")
    assert done.returncode == 0, done.stderr


class Arm:
    """A simulated arm that holds itself, and where it really was since then."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.control = SimControl(program.json()["control"])
        for name in ("power_on", "release_brakes"):
            self.service(name)()
        self.was: list[tuple[float, list[float]]] = []
        self._ended = threading.Event()
        self._looks = threading.Thread(target=self._look)
        self._looks.start()

    def service(self, name: str) -> trade.Handle:
        return trade.find(where(name=name, group="ada.right", kind="Arm"), wait_s=PATIENCE_S).with_(
            deadline_s=PATIENCE_S
        )

    def _look(self) -> None:
        while not self._ended.wait(0.01):
            self.was.append((time.monotonic(), self.control.arm("right").positions_rad))

    def tracks(self) -> list[Track]:
        """Where each joint was, from when the last of them was at home."""
        was = list(dropwhile(lambda at: math.dist(at[1], HOME) > 0.02, self.was))
        times_s = [at_s - was[0][0] for at_s, _ in was]
        return [Track(times_s, list(angles)) for angles in zip(*(angles for _, angles in was), strict=True)]

    def close(self) -> None:
        self._ended.set()
        self._looks.join()
        self.control.close()
        self.program.close()


@pytest.fixture
def arm_up(run: Callable[..., Program]) -> Iterator[Callable[[], Arm]]:
    """Brings an arm up, simulated; one at a time."""
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
    with ExitStack() as undo:

        def up() -> Arm:
            arm = Arm(run("-m", "trade_gateway", "up", ARM, "--sim", "--json"))
            undo.callback(arm.close)
            return arm

        yield up


def test_an_arm_that_is_replayed_in_a_second_simulation_goes_where_it_went_in_the_first(
    arm_up: Callable[[], Arm],
    run: Callable[..., Program],
    trade_command: Callable[..., subprocess.CompletedProcess[str]],
    tmp_path: Path,
) -> None:
    first, file = arm_up(), tmp_path / "wave.mcap"
    recording = run("-m", "trade_gateway", "record", file, "--json")
    recording.wait_for(lambda line: line.get("messages", 0) > 20)
    for wave in WAVES:
        first.service("move_joints")([*wave, *HOME[2:]])
    recording.signal(signal.SIGINT)
    assert recording.wait() == 0
    first.close()
    wait_until(lambda: not trade.services(where(group="ada")))
    second = arm_up()
    second.service("move_joints")([0.3, *HOME[1:]])
    second.was.clear()
    refused = trade_command("replay", file, "--speed", "0.8")
    assert refused.returncode == 1
    assert "+0.30 rad off; --go-to-start moves it there first" in " ".join(refused.stderr.split())
    words = ("--speed", "0.8", "--go-to-start", "--tolerance-rad", str(TOLERANCE_RAD), "--json")
    done = trade_command("replay", file, *words)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["joints"] == [joint.name for joint in second.service("limits")().joints]
    waved = moving(motion_of("ada.right", motions(file)["ada.right"]))
    assert [round(max(track.positions_rad), 1) for track in waved.tracks][:2] == [0.5, -1.3]
    found, _ = deviation(waved, 0.8, Motion("ada.right", waved.joints, second.tracks()), latest_s=PATIENCE_S)
    assert max(found.greatest_rad) <= TOLERANCE_RAD


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_a_viewer_sees_live_what_a_recording_would_have(
    rosie_up: Callable[[], Rosie], run: Callable[..., Program], ending: signal.Signals
) -> None:
    rosie_up()
    showing = run("-m", "trade_gateway", "foxglove", "--group", "rosie.head", "--port", "0", "--json")
    ready = showing.json()
    assert ready["services"] == ["rosie.head.state"]
    with viewer(ready["url"]) as looking:
        looking.subscribe("/rosie.head/joints")
        places: list[float] = []
        look = trade.find(where(name="move_to", group="rosie.head"), wait_s=PATIENCE_S).start([0.5, 0.0])
        while not places or places[-1] < 0.4:
            places.append(looking.message()[2]["position_rad"][0])
        look.result()
        assert places[0] < 0.1
        assert len({round(place, 2) for place in places}) > 5
        looking.subscribe("/locks")
        while looking.message()[0] != "/locks":
            pass
        showing.signal(ending)
        assert showing.wait() == 0
    assert [line for line in showing.errors if UNKNOWN not in line] == []


def test_a_live_view_that_other_hosts_can_reach_prints_a_warning(
    run: Callable[..., Program],
) -> None:
    showing = run("-m", "trade_gateway", "foxglove", "--host", "127.1", "--port", "0", "--json")
    showing.json()
    showing.signal(signal.SIGINT)
    assert showing.wait() == 0
    assert "warning: every host that reaches ws://127.1:" in "".join(showing.errors)
