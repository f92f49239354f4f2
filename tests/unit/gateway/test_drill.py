"""What a drill is made of: its scenes, limits, judge and report. The drill itself is in tests/system."""

import json
import re
import time
from pathlib import Path

import msgspec
import pytest

from trade_checks._cases import chosen
from trade_checks.drill import (
    SCENES,
    Report,
    Scene,
    SceneReport,
    Stop,
    Target,
    _runner,
    as_data,
    page,
    play,
    targets_of,
)
from trade_checks.drill._runner import DrillFailed
from trade_checks.drill._scenes import ALLOWANCE_S, limit_s
from trade_checks.drill._testbed import Judge
from trade_drivers import load
from trade_gateway._usage import UsageError
from trade_robotfile import Drill

pytestmark = pytest.mark.virtual_time

EXAMPLES = Path(__file__).parents[3] / "examples"
DRILL_PAGE = EXAMPLES.parent / "docs" / "drill.md"
BY_NAME = {scene.name: scene for scene in SCENES}


def test_each_scene_has_its_limit_in_the_robot_file_and_no_other_key_exists() -> None:
    assert set(BY_NAME) == set(Drill.__struct_fields__)
    assert len(BY_NAME) == len(SCENES)


def test_the_page_on_drills_has_a_row_for_each_scene_with_the_rule_it_shows() -> None:
    rows = re.findall(r"^\| `(\w+)` \|.*?\| \[?(S\d\d)", DRILL_PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert rows == [(scene.name, scene.shows) for scene in SCENES]


def test_of_each_bus_the_widest_joint_or_the_arm_moves_and_a_gripper_does_not() -> None:
    targets, left_out = targets_of(load(EXAMPLES / "rosie.toml"))
    found = {target.bus: target.name for target in targets}
    assert found.items() >= {"neck": "neck.pan", "right_arm": "right.wrist.roll", "tail": "tail.tip"}.items()
    assert left_out["hand"] == "a gripper ends its stroke by itself"
    assert set(found) | set(left_out) == {bus.name for bus in load(EXAMPLES / "rosie.toml").buses}


def test_a_coupled_joint_moves_only_where_there_is_no_other() -> None:
    head = load(EXAMPLES / "head.toml")
    pan, tilt = head.joints
    coupled = type(load(EXAMPLES / "dora.toml").coupled[0])
    with_pan = msgspec.structs.replace(head, coupled=[coupled(joints=[pan.name, "other"])])
    assert targets_of(with_pan)[0][0].name == tilt.name
    with_both = msgspec.structs.replace(head, coupled=[coupled(joints=[pan.name, tilt.name])])
    assert targets_of(with_both)[0][0].name == pan.name


@pytest.mark.parametrize("angle", [-1.4, -0.2, 0.0, 0.3, 1.4])
def test_a_joint_is_sent_to_its_farther_end_slowly_and_stays_within_its_range(angle: float) -> None:
    [pan], _ = targets_of(load(EXAMPLES / "head.toml"))
    goal, speed = pan.way(angle)
    assert pan.min_rad < goal < pan.max_rad
    assert abs(goal - angle) > (pan.max_rad - pan.min_rad) * 0.4
    assert 0 < speed < pan.max_speed_rad_s / 10


def test_a_limit_is_what_the_robot_file_says_or_what_the_rules_say_of_that_joint() -> None:
    [pan], _ = targets_of(load(EXAMPLES / "head.toml"))
    braking_s = 2.5 / 20.0
    assert limit_s(BY_NAME["driver_killed"], pan, Drill()) == pytest.approx(0.3 + braking_s + ALLOWANCE_S)
    assert limit_s(BY_NAME["caller_killed"], pan, Drill()) == pytest.approx(braking_s + ALLOWANCE_S)
    assert limit_s(BY_NAME["partition"], pan, Drill()) == pytest.approx(3.0 + braking_s + ALLOWANCE_S)
    given = Drill(driver_killed=0.001)
    assert limit_s(BY_NAME["driver_killed"], pan, given) == 0.001
    assert limit_s(BY_NAME["driver_frozen"], pan, given) > 0.3


def test_bus_off_concerns_can_buses_alone() -> None:
    [pan], _ = targets_of(load(EXAMPLES / "head.toml"))
    [leg], _ = targets_of(load(EXAMPLES / "legs.toml"))
    assert [scene.name for scene in SCENES if not scene.concerns(pan)] == ["bus_off"]
    assert all(scene.concerns(leg) for scene in SCENES)


def test_an_arm_that_would_be_there_before_its_stream_is_over_shows_nothing_about_streams() -> None:
    [arm], _ = targets_of(load(EXAMPLES / "arm.toml"))
    fast = msgspec.structs.replace(arm, max_speed_rad_s=3.0)
    assert BY_NAME["stream_frozen"].concerns(arm)
    assert [scene.name for scene in SCENES if not scene.concerns(fast)] == ["stream_frozen", "bus_off"]


def test_scenes_are_chosen_by_name_and_held_in_the_order_of_the_table() -> None:
    assert chosen(SCENES, [], "scene") == list(SCENES)
    assert [scene.name for scene in chosen(SCENES, ["partition", "caller_killed"], "scene")] == [
        "caller_killed",
        "partition",
    ]
    with pytest.raises(UsageError, match="there is no such scene; there is caller_killed"):
        chosen(SCENES, ["fire"], "scene")


def test_the_judge_reads_a_log_while_it_is_written(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"

    def write(*entries: tuple[float, str], end: str = "\n") -> None:
        lines = [json.dumps({"t": t, "bus": "b", "kind": "event", "name": n, "joint": "j"}) for t, n in entries]
        with log.open("a") as file:
            file.write("\n".join(lines).replace('": ', '":') + end)

    judge = Judge(log)
    write((1.0, "motion_started"), (1.5, "torque_on"), (2.0, "at_rest"))
    judge.look()
    assert (judge.moves("j"), judge.moves("j", at=1.5), judge.rested("j")) == (False, True, 2.0)
    write((3.0, "motion_started"), end="")
    judge.look()
    assert not judge.moves("j")
    write(end="\n")
    judge.look()
    assert judge.moves("j")
    assert (judge.began("j", since=2.0), judge.began("j", since=3.0)) == (3.0, None)
    assert not judge.moves("another")


def _report(*stops: Stop, problems: tuple[str, ...] = ()) -> Report:
    played = SceneReport(scene="unplug", what="a <b>", shows="S06", stops=list(stops), problems=list(problems))
    good = SceneReport(scene="partition", what="cut", shows="S05", stops=[_stop(1.0)])
    return Report(
        robot="rosie",
        file="r.toml",
        version="1",
        host="h",
        at="2026-11-22",
        scenes=[good, played],
        left_out={"hand": "x"},
    )


def _stop(took_s: float | None, again_s: float | None = None) -> Stop:
    return Stop(joint="neck.pan", bus="neck", took_s=took_s, limit_s=2.0, again_s=again_s)


@pytest.mark.parametrize(
    ("stop", "verdict"),
    [
        (_stop(2.0), "ok"),
        (_stop(2.1), "too long"),
        (_stop(None), "did not stop"),
        (_stop(1.0, again_s=3.0), "moved again"),
    ],
)
def test_a_drill_is_passed_if_each_joint_kept_its_limit_and_rested(stop: Stop, verdict: str) -> None:
    report = _report(stop)
    assert report.ok == (verdict == "ok")
    reported = as_data(report)
    assert reported["ok"] == report.ok
    assert reported["scenes"][1]["stops"][0]["verdict"] == verdict
    assert f">{verdict}" in page(report)


def test_a_scene_that_could_not_be_held_is_not_passed_and_neither_is_a_drill_without_scenes() -> None:
    report = _report(problems=("the driver ended", "it rested"))
    assert not report.ok
    assert "the driver ended" in page(report)
    assert not msgspec.structs.replace(report, scenes=[]).ok


def test_a_scene_that_was_held_at_last_is_passed_and_the_page_says_what_kept_it() -> None:
    report = _report(_stop(1.0), problems=("the driver ended",))
    assert report.ok
    assert "the driver ended" in page(report)


class BusyStand:
    """A stand on which nothing begins, as often as it was said."""

    def __init__(self, failures: int) -> None:
        self.failures, self.calls, self.dismissed = failures, 0, 0

    def recover(self) -> None:
        self.calls += 1
        if self.calls <= self.failures:
            raise DrillFailed(problem="too busy")
        raise NothingMeasured

    def dismiss(self) -> None:
        self.dismissed += 1


class NothingMeasured(Exception):
    pass


def test_a_scene_is_tried_three_times_and_no_more() -> None:
    stand = BusyStand(failures=3)
    played = play(stand, BY_NAME["partition"], [], Drill())
    assert (played.problems, played.stops) == (["too busy"] * 3, [])
    assert (stand.calls, stand.dismissed) == (3, 3)
    again = BusyStand(failures=2)
    with pytest.raises(NothingMeasured):
        play(again, BY_NAME["partition"], [], Drill())
    assert again.dismissed == 3


def test_the_page_needs_no_other_file_and_shows_the_worst_first() -> None:
    text = page(_report(_stop(1.9)))
    assert text.index("unplug") < text.index("partition")
    assert "a &lt;b&gt;" in text
    assert "hand: x" in text
    assert not re.search(r"<script|https?:|src=|@import", text)
    widths = [float(width) for width in re.findall(r"<i[^>]* style=\"width: ([\d.]+)%", text)]
    assert widths[0] > widths[1]
    assert max(widths) < 70.0


def test_a_bar_ends_with_the_page_however_long_it_took() -> None:
    assert 'width: 100.0%"' in page(_report(_stop(1e6)))
    assert 'width: 100.0%"' in page(_report(_stop(None)))


class ScriptedStand:
    """A stand whose joint does what a script says: times relative to the failure, and whether it moves from then on."""

    def __init__(self, log: Path, script: list[tuple[float, bool]], after_repair: list[tuple[float, bool]]) -> None:
        self._log, self._script, self._after_repair = log, script, after_repair
        self._recovered = 0
        self.judge = Judge(log)

    def recover(self) -> None:
        self._recovered += 1
        if self._recovered == 2:  # the first time is before the failure
            self._write(time.monotonic(), self._after_repair)

    def call(self, scene: Scene, targets: list[Target]) -> "ScriptedStand":
        return self

    def tell(self) -> None:
        self._write(time.monotonic(), [(0.0, True)])

    def objection(self) -> str:
        return ""

    def strike(self, scene: Scene, targets: list[Target]) -> float:
        now = time.monotonic()
        self._write(now, self._script)
        return now

    def look(self) -> None:
        self.judge.look()

    def dismiss(self) -> None:
        pass

    def _write(self, zero: float, script: list[tuple[float, bool]]) -> None:
        names = {True: "motion_started", False: "at_rest"}
        lines = [msgspec.json.encode({"t": zero + t, "name": names[on], "joint": "neck.pan"}) for t, on in script]
        with self._log.open("ab") as file:
            file.writelines(line + b"\n" for line in lines)


@pytest.mark.parametrize(
    ("script", "after_repair", "verdict"),
    [
        ([(0.002, False)], [], "ok"),
        ([(0.002, False), (0.003, True), (0.9, False)], [], "too long"),
        ([], [], "did not stop"),
        ([(0.002, False), (0.003, True)], [], "did not stop"),
        ([(0.002, False)], [(0.001, True), (0.002, False)], "moved again"),
    ],
    ids=["rests", "is led on", "continues", "begins again", "moves by itself later"],
)
def test_a_joint_is_judged_by_when_it_rested_for_good(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    script: list[tuple[float, bool]],
    after_repair: list[tuple[float, bool]],
    verdict: str,
) -> None:
    for name, seconds in (("_ON_ITS_WAY_S", 0.01), ("_QUIET_S", 0.05), ("_REST_S", 2.0)):
        monkeypatch.setattr(_runner, name, seconds)
    targets, _ = targets_of(load(EXAMPLES / "head.toml"))
    stand = ScriptedStand(tmp_path / "log.jsonl", script, after_repair)
    played = play(stand, BY_NAME["unplug"], targets, Drill(unplug=0.5))
    assert (played.problems, [stop.verdict for stop in played.stops]) == ([], [verdict])


def test_a_joint_that_rested_before_the_failure_proves_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name, seconds in (("_ON_ITS_WAY_S", 0.01), ("_QUIET_S", 0.05)):
        monkeypatch.setattr(_runner, name, seconds)
    targets, _ = targets_of(load(EXAMPLES / "head.toml"))
    stand = ScriptedStand(tmp_path / "log.jsonl", [(-0.001, False)], [])
    played = play(stand, BY_NAME["unplug"], targets, Drill())
    assert not played.ok
    assert all("was at rest before the failure" in problem for problem in played.problems)
