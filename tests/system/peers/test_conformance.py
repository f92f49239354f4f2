"""`trade conformance`: this project's own container passes it, and who breaks a rule fails the check of that rule."""

import json
import os
import runpy
import select
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from trade_checks.conformance import CHECKS

PEER = Path(__file__).with_name("peer.py")
NOTICED_BY = {
    "runs-late": "late-is-never",
    "runs-twice": "once",
    "forgets-the-latest": "once-without-expiry",
    "ignores-locks": "locks",
    "ignores-sessions": "session-ends",
    "ignores-stops": "stops",
    "stops-late": "stops",
    "stops-in-line": "stop-beside-waiting",
    "trusts-its-namesakes": "stop-latches-own",
    "ignores-epochs": "locks",
    "outlives-its-caller": "calls-no-longer",
    "believes-any-estop": "estop-forged",
    "hears-its-own-version-only": "estop-of-any-version",
    "never-latches": "stop-latches",
    "ignores-estops": "estop",
    "forgets-estops": "estop-kept",
    "learns-no-estops": "estop-learnt",
    "any-version": "versions",
    "ignores-cancels": "cancels",
    "endless-leases": "leases",
    "grants-what-moves": "waits-for-motion",
    "answers-nonsense": "turns",
    "sends-no-report": "reports-late",
}
"""What is broken, and which check has to fail."""


def conformance(*words: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "trade_gateway", "conformance", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)


def reported(ended: "subprocess.CompletedProcess[str]") -> list[dict[str, Any]]:
    return [json.loads(line) for line in ended.stdout.splitlines()]


def start(*words: str) -> str:
    return f"{sys.executable} {PEER} {' '.join(words)}"


def failed(outcomes: Sequence[dict[str, Any]]) -> dict[str, str]:
    return {one["check"]: one["why"] for one in outcomes if one["outcome"] == "failed"}


@pytest.mark.timeout(600)
def test_a_container_of_this_project_passes_every_check() -> None:
    ended = conformance("--peer", start(), "--motion", "--json")
    outcomes = reported(ended)
    assert failed(outcomes) == {}
    assert [one["check"] for one in outcomes] == [one.name for one in CHECKS]
    assert {one["outcome"] for one in outcomes} == {"ok"}
    assert ended.returncode == 0


@pytest.mark.timeout(600)
@pytest.mark.parametrize("broken", NOTICED_BY)
def test_a_container_that_breaks_a_rule_fails_its_check(broken: str) -> None:
    only = ("--only", "presence", "--only", NOTICED_BY[broken])
    ended = conformance("--peer", start(broken), "--motion", *only, "--json")
    assert list(failed(reported(ended))) == [NOTICED_BY[broken]], ended.stdout
    assert ended.returncode == 1


def test_every_way_to_break_a_rule_is_tried() -> None:
    assert set(runpy.run_path(str(PEER.with_name("broken.py")))["BREAK"]) == set(NOTICED_BY)


NOTING = """
import sys, typing
sys.path[:0] = [{here!r}]
import peer
from trade import service

class Noting(peer.Arm):
    @service
    def turn(self, angle_rad: float) -> float:
        open({note!r}, "w").close()
        return super().turn(angle_rad)

class Armless:
    @service(effect="read")
    def echo(self, value: typing.Any) -> typing.Any:
        return value

peer.Arm = {arm}
peer.main()
"""


@pytest.mark.timeout(300)
@pytest.mark.parametrize("arm", ["Noting", "Armless"])
def test_without_motion_the_arm_is_never_turned_and_need_not_exist(arm: str, tmp_path: Path) -> None:
    program, note = tmp_path / "noting.py", tmp_path / "turned"
    program.write_text(NOTING.format(here=str(PEER.parent), note=str(note), arm=arm), encoding="utf-8")
    ended = conformance("--peer", f"{sys.executable} {program}", "--json")
    outcomes = reported(ended)
    assert failed(outcomes) == {}
    assert {one["check"] for one in outcomes if one["outcome"] == "ok"} == {one.name for one in CHECKS if one.still}
    why = {one["why"] for one in outcomes if one["outcome"] == "left out"}
    assert why == {"it is of motion; --motion turns the arm"}
    assert ended.returncode == 0
    assert not note.exists()


def test_a_check_of_motion_by_its_name_needs_the_option() -> None:
    refused = conformance("--peer", start(), "--only", "stops")
    assert refused.returncode == 2
    assert "add --motion" in " ".join(refused.stderr.split())


@pytest.mark.parametrize("signs", ["one sign of life", "none"])
def test_a_shell_that_starts_it_leaves_nothing_behind(signs: str, tmp_path: Path) -> None:
    inherited = tmp_path / "inherited"  # its reader sees the end once all have ended who were started
    os.mkfifo(inherited)
    reader = os.open(inherited, os.O_RDONLY | os.O_NONBLOCK)
    begin = f"exec {start()}" if signs == "one sign of life" else "exit 0"
    script = tmp_path / "begin.sh"
    script.write_text(f"exec 9> {inherited}\necho began >&9\nsleep 1000 &\n({begin}) &\nwait $!\n", encoding="utf-8")
    try:
        ended = conformance("--peer", f"sh {script}", "--motion", "--only", "presence", "--only", "restarts", "--json")
        began = os.read(reader, 1000)
        heard, _, _ = select.select([reader], [], [], 30.0)
        assert (heard, os.read(reader, 1)) == ([reader], b"")
    finally:
        os.close(reader)
    assert set(began.split()) == {b"began"}
    assert bool(failed(reported(ended))) == (signs == "none"), ended.stdout


def test_a_command_that_ends_fails_its_checks_and_its_output_is_shown() -> None:
    ended = conformance("--peer", f"{sys.executable} -c 'raise SystemExit(\"no robot today\")'", "--only", "presence")
    assert ended.returncode == 1
    assert "no robot today" in " ".join(ended.stdout.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--peer", "no-such-program-anywhere"], "cannot be started"),
        (["--peer", ""], "names no program"),
        (["--peer", "'"], "cannot be read as words"),
    ],
)
def test_a_command_that_cannot_be_started_is_an_error(words: list[str], said: str) -> None:
    ended = conformance(*words)
    assert ended.returncode == 1
    assert said in " ".join(ended.stderr.split())


def test_an_unknown_check_and_a_missing_command_are_usage_errors() -> None:
    assert conformance("--peer", "true", "--only", "no-such-check").returncode == 2
    assert conformance().returncode == 2


def test_the_checks_are_listed_with_their_rules() -> None:
    listed = reported(conformance("--list", "--json"))[0]
    assert [one["check"] for one in listed] == [one.name for one in CHECKS]
    assert all(one["rule"] and one["what"] for one in listed)
    assert len({one.name for one in CHECKS}) == len(CHECKS)
