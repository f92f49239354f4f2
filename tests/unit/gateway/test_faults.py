"""What `trade up` reports of its devices, once for each change; and that `trade services` shows what is unhealthy."""

import json
from typing import Any

import pytest

from tests.support.simulated_robots import HAND, HEAD
from trade_drivers import FaultLog, parse
from trade_drivers.faults._fault_update import DetectedFault
from trade_gateway.cli.robots._up import FaultWatch
from trade_gateway.terminal._output import Output

OVERLOAD = DetectedFault("overload", "rosie.pan: overload", "remove the cause")
BLOCKED = DetectedFault("is it blocked?", "rosie.pan: is it blocked?", "remove the cause")
SILENT = DetectedFault("silent", "rosie.pan did not answer")
PROTECTIVE = DetectedFault("protective stop", "rosie.pan: protective stop", "call unlock_protective_stop()")
BEGIN: dict[str, tuple[Any, str]] = {
    "overload": (OVERLOAD, "rosie.pan: overload. When you have looked: trade call rosie.pan.enable"),
    "blocked": (BLOCKED, "rosie.pan: is it blocked? When you have looked: trade call rosie.pan.enable"),
    "silent": (SILENT, "rosie.pan did not answer"),
}


ROBOT = parse(HEAD.replace("neck.pan", "pan"), "head.toml")


@pytest.fixture
def log() -> FaultLog:
    return FaultLog("rosie")


def reported(capsys: pytest.CaptureFixture[str]) -> list[tuple[str, str]]:
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    return [(line["joint"], line["fault"]) for line in lines]


@pytest.mark.parametrize(("found", "line"), BEGIN.values(), ids=BEGIN)
def test_each_change_is_reported_once_in_both_directions(
    found: DetectedFault, line: str, log: FaultLog, capsys: pytest.CaptureFixture[str]
) -> None:
    watch, out = FaultWatch(ROBOT, lambda: log.faults(open_only=True)), Output(as_json=True)
    assert not watch.report(out)
    log.begin("rosie.pan", found, 0.0, 0.0)
    assert [watch.report(out), watch.report(out)] == [True, False]
    assert reported(capsys) == [("rosie.pan", line)]
    log.end("rosie.pan", found.kind, 1.0, 1.0)
    assert [watch.report(out), watch.report(out)] == [True, False]
    assert reported(capsys) == [("rosie.pan", "")]


def test_the_remedy_of_a_gripper_is_to_activate_it(log: FaultLog, capsys: pytest.CaptureFixture[str]) -> None:
    watch = FaultWatch(parse(HAND.replace("left.hand", "pan"), "hand.toml"), lambda: log.faults(open_only=True))
    log.begin("rosie.pan", OVERLOAD, 0.0, 0.0)
    watch.report(Output(as_json=True))
    assert reported(capsys) == [
        ("rosie.pan", "rosie.pan: overload. When you have looked: trade call rosie.pan.activate")
    ]


def test_of_two_faults_the_newest_is_shown_and_health_returns_when_both_are_gone(
    log: FaultLog, capsys: pytest.CaptureFixture[str]
) -> None:
    watch, out = FaultWatch(parse(HEAD, "head.toml"), lambda: log.faults(open_only=True)), Output(as_json=True)
    log.begin("rosie.pan", PROTECTIVE, 0.0, 0.0)
    log.begin("rosie.pan", SILENT, 0.0, 0.0)
    watch.report(out)
    log.end("rosie.pan", "silent", 1.0, 1.0)
    watch.report(out)
    log.end("rosie.pan", "protective stop", 1.0, 1.0)
    watch.report(out)
    remedied = "rosie.pan: protective stop; `trade call rosie.pan.unlock_protective_stop`"
    assert [text for _, text in reported(capsys)] == ["rosie.pan did not answer", remedied, ""]
