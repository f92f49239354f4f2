"""``make demo``: the story runs to its end on both kinds of networks, and nothing is left of it."""

import json
import math
import os
import re
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jsonschema_rs
import msgspec
import pytest
from mcap.reader import make_reader

from tests.support.http_clients import Client
from tests.support.waiting import wait_until
from tests.system.conftest import ROOT, Program
from tests.system.networks import ip, why_not
from trade_drivers import load, parse
from trade_gateway.recording._motion import Motion, Track, deviation, motion_of, motions, moving
from trade_hil_sim import frames, motion_writes, read_log

pytestmark = pytest.mark.timeout(300)

DEMO = ROOT / "examples" / "demo.py"
ROSIE = ROOT / "examples" / "rosie.toml"
TOPICS = {
    *(f"/rosie.{group}/joints" for group in ("head", "right.arm", "legs", "tail")),
    *("/calls", "/locks", "/faults"),
}
PATIENT = (
    "rate_hz = 50            # SYNCs per second\nstale_after_s = 0.5\nwatchdog_s = 0.3",
    "rate_hz = 50\nstale_after_s = 2\nwatchdog_s = 2",
)
TOLERANCE_RAD = 0.1
SPEED = 0.5
"""What was measured rarely, on a busy host, looks quicker than it was, and its legs were near their limits."""
Run = Callable[..., Program]
Command = Callable[..., subprocess.CompletedProcess[str]]


def reported(demo: Program, until: str) -> str:
    """What it says, up to these words."""
    story = ""
    while until not in story:
        story += demo.line()
    return story


def test_a_demo_that_fails_on_a_busy_computer_says_so() -> None:
    busy = runpy.run_path(str(DEMO.with_name("demo_busy.py")))["busy"]
    assert busy(40.0, 2).startswith("this computer is busy (load 40 on 2 cores); try again when it is not")
    assert not busy(1.0, 2)


@pytest.mark.parametrize("name", ["rosie.toml", "head.toml"])
def test_the_robot_of_the_demo_differs_from_the_example_in_rates_and_times_only(name: str) -> None:
    patient = runpy.run_path(str(DEMO.with_name("demo_robot.py")))["patient"]
    text = DEMO.with_name(name).read_text(encoding="utf-8")
    example, made = parse(text, name), parse(patient(text), name)
    assert msgspec.structs.replace(made, buses=example.buses, given=example.given) == example
    for before, after in zip(example.buses, made.buses, strict=True):
        assert after.rate_hz <= before.rate_hz
        assert after.watchdog_s >= before.watchdog_s
        assert after.stale_after_s > before.stale_after_s
        times = {"rate_hz": before.rate_hz, "watchdog_s": before.watchdog_s, "stale_after_s": before.stale_after_s}
        assert msgspec.structs.replace(after, **times) == before


BUSY = "import os\nwhile os.getppid() == {parent}:\n    for _ in range(10**6):\n        pass"
"""It keeps one core busy until it is killed, or the process that started it has ended."""
FAULTY = re.compile(
    r"did not answer|does not answer|held up|watchdog|silent|fault|too busy|is busy|lost|warning|Traceback|\wError"
    r"|DeadlineExceeded|OutcomeUnknown|ToleranceExceeded|NotStopped|demo failed",
    re.IGNORECASE,
)
"""What a demo without faults of devices does not say."""


@contextmanager
def busy_cores() -> Generator[None]:
    with ExitStack() as undo:
        for _ in range(os.cpu_count() or 1):
            words = [sys.executable, "-S", "-c", BUSY.format(parent=os.getpid())]
            program = subprocess.Popen(words, start_new_session=True)
            undo.callback(program.wait)
            undo.callback(program.kill)
        yield


def left_of(story: str) -> list[str]:
    """Folders and namespaces that a demo named and that are still there."""
    named = set(re.findall(r"trade-demo-[\w-]+", story))
    assert named
    there = {path.name for path in Path(tempfile.gettempdir()).iterdir()}
    there |= set() if why_not() else {line.split()[0] for line in ip("netns", "list").splitlines() if line}
    return sorted(named & there)


def test_rosie_walks_through_a_gateway_between_two_networks(run: Run) -> None:
    if reason := why_not():
        pytest.skip(reason)
    demo = run(DEMO)
    story = reported(demo, "confirms every line above")
    assert demo.wait() == 0, demo.errors
    assert "The networks are network namespaces" in story
    assert "has the legs, for 'walk'" in story
    assert sorted(re.findall(r"(\w+) +process \d+ was killed", story)) == ["head", "lamp"]
    assert sorted(re.findall(r"(\w+) +is served again", story)) == ["head", "lamp"]
    assert "0 writes that could move it; neck.pan at +0.3" in story
    assert "the new lamp shines at 0.7" in story
    assert left_of(story) == []


def test_rosie_walks_through_gateways_on_loopback_addresses_and_all_of_it_is_recorded_and_can_be_replayed(
    run: Run, trade_command: Command, tmp_path: Path
) -> None:
    file = tmp_path / "demo.mcap"
    demo = run(DEMO, "--loopback", "--record", file)
    story = reported(demo, "confirms every line above")
    assert demo.wait() == 0, demo.errors
    assert "loopback addresses of this host, as you said --loopback" in story
    assert "has the legs, for 'walk'" in story
    said = by_topic(file)
    assert said.keys() >= TOPICS | ({"/rosie.left.arm/joints"} if "bus left_arm" not in story else set())
    assert {call["service"] for call in said["/calls"]} >= {
        "rosie.head.move_to",
        "rosie.legs.follow",
        "rosie.lamp.shine",
    }
    assert {lock["purpose"] for locks in said["/locks"] for lock in locks["locks"]} >= {"walk", "watch the way"}
    gone = [fault["about"] for fault in said["/faults"] if fault["kind"] == "gone"]
    assert gone.count("rosie.lamp") >= 2  # killed, and at the end
    assert gone.count("rosie.head") >= 3  # that of the first robot, too
    assert_replayed(file, run, trade_command, tmp_path / "again.jsonl")


def by_topic(file: Path) -> dict[str, list[Any]]:
    """All that is in a recording, after each message was checked against the schema of its channel."""
    found: dict[str, list[Any]] = {}
    validators: dict[int, jsonschema_rs.Validator] = {}
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if schema.id not in validators:
                validators[schema.id] = jsonschema_rs.validator_for(json.loads(schema.data))
            said = json.loads(message.data)
            validators[schema.id].validate(said)
            found.setdefault(channel.topic, []).append(said)
    return found


def assert_replayed(file: Path, run: Run, trade_command: Command, log: Path) -> None:
    """The walk, in a fresh simulation of the same robot: its own log has the drives where the recording has them."""
    patient = log.with_name("rosie.toml")  # drives that do not stop at once where the host is busy
    patient.write_text(ROSIE.read_text(encoding="utf-8").replace(*PATIENT), encoding="utf-8")
    without = [word for bus in load(ROSIE).buses if bus.name != "legs" for word in ("--without", bus.name)]
    words = ("--sim", "--sim-log", log, "--json", *without)
    run("-m", "trade_gateway", "up", patient, *words).json()
    assert trade_command("call", "rosie.legs.enable").returncode == 0
    enabled_s = read_log(log)[-1].t
    words = ("--group", "rosie.legs", "--speed", str(SPEED), "--tolerance-rad", "1")  # the log judges
    done = trade_command("replay", file, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    walked = moving(motion_of("rosie.legs", motions(file)["rosie.legs"]))
    assert [round(max(track.positions_rad), 1) for track in walked.tracks][:2] == [0.3, 0.8]
    began_s = motion_writes(read_log(log), since=enabled_s)[0].t
    found, _ = deviation(walked, SPEED, Motion("rosie.legs", walked.joints, by_drives(log, began_s)))
    assert max(found.greatest_rad) <= TOLERANCE_RAD


def by_drives(log: Path, since: float) -> list[Track]:
    """Where each drive of the legs said that it was, in the log of its simulation."""
    tracks: list[Track] = []
    for joint in load(ROSIE).joints_on("legs"):
        assert joint.counts_per_rev
        reported = frames(read_log(log), "tpdo1", device_id=joint.id, since=since)
        rad_per_count = math.tau / (joint.counts_per_rev * joint.gear)
        counts = [int.from_bytes(frame.data[2:6], "little", signed=True) for frame in reported]
        tracks.append(Track([frame.t - since for frame in reported], [count * rad_per_count for count in counts]))
    return tracks


def test_the_demo_fails_when_the_simulator_is_muted(run: Run) -> None:
    demo = run(DEMO, "--mute")
    story = reported(demo, "no longer answer")
    assert demo.wait() == 1
    said = "".join(demo.errors)
    assert "the demo failed" in said
    assert "DeviceSilent" in said
    assert why_not() or left_of(story) == []


def test_a_demo_that_stays_shows_a_page_ends_with_ctrl_c_and_leaves_nothing(run: Run) -> None:
    demo = run(DEMO, "--stay")
    story = reported(demo, "the head turns while you do")
    [url], [token] = re.findall(r"in a browser: (\S+)", story), re.findall(r"token: (\S+)", story)
    anna = Client(url, token)
    assert anna.ask("GET", "/").status == 200
    wait_until(lambda: anna.ask("GET", "/services?group=rosie.neck.pan&name=set_velocity").body, "rosie is seen")
    demo.signal(signal.SIGINT)
    assert demo.wait() == 0, demo.errors
    rest = "".join(demo.lines())
    assert "was killed" not in rest
    assert "Done in" in rest
    assert left_of(story) == []


def test_a_demo_that_is_ended_in_the_middle_leaves_nothing(run: Run) -> None:
    demo = run(DEMO, "--stay")
    story = reported(demo, "Two behaviours want the same head")
    demo.signal(signal.SIGTERM)
    assert demo.wait() == 130, demo.errors
    assert why_not() or left_of(story) == []


# Last, as it keeps all cores busy.
def test_rosie_walks_beside_a_busy_process_for_each_core_and_nothing_looks_like_a_fault(run: Run) -> None:
    with busy_cores():
        demo = run(DEMO)
        story = reported(demo, "confirms every line above")
        assert demo.wait() == 0, demo.errors
    assert not FAULTY.findall(story)
    assert demo.errors == []
