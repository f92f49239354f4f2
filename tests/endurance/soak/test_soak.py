"""The soak: its judge, and a short one with all that a long one has."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.endurance.soak.judge import Run, Said, Sample, judge

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
SECONDS = 400
PATIENCE_S = 300
SILENT = "DeviceSilent: x"


def samples(**changed: Any) -> list[Sample]:
    """A process that stays as it is, but for what changes in the second half."""
    same = {"process": "driver", "pid": 7, "rss_mib": 100.0, "files": 20, "threads": 30}
    return [Sample(t=t, cpu_s=t / 3, **{**same, **(changed if t > SECONDS / 2 else {})}) for t in range(0, SECONDS, 5)]


def said(until: int = SECONDS, errors: dict[str, int] | None = None) -> list[Said]:
    return [
        Said(t=t, planner="head", counts={"rounds": 1 + min(t, until) // 10}, errors=errors or {})
        for t in range(10, SECONDS, 10)
    ]


RELAXED = "DeviceFault: rosie.legs.left.hip on can0: error 8130h, it has not heard this driver for too long; remove ..."
FAULT = "DeviceFault: rosie.tail.tip on can0: overload; remove the cause, then call enable()"
GOOD = Run(seconds=SECONDS, samples=samples(), said=said(), passers=3)


@pytest.mark.parametrize(
    ("run", "says"),
    [
        (GOOD, ""),
        (Run(seconds=SECONDS, samples=samples(rss_mib=107.0, files=23, threads=33), said=said()), ""),
        (Run(seconds=SECONDS, samples=samples(rss_mib=109.0), said=said()), "driver grew by 9.0 MiB"),
        (Run(seconds=SECONDS, samples=samples(files=25), said=said()), "driver has 5 more files open"),
        (Run(seconds=SECONDS, samples=samples(threads=35), said=said()), "driver has 5 more threads"),
        (Run(seconds=SECONDS, samples=samples(pid=8), said=said()), "driver was started again 1 times"),
        (Run(seconds=SECONDS, samples=samples()[:50], said=said()), "driver was not there all the time"),
        (Run(seconds=SECONDS, samples=samples(), said=said(until=200)), "head did nothing from 200 s to 400 s"),
        (Run(seconds=SECONDS, samples=samples(), said=said(errors={"Timeout: x": 2})), "head: Timeout: x (2 times)"),
        (
            Run(seconds=SECONDS, samples=samples(), said=said(errors={SILENT: 1})),
            "x (1 times)",
        ),
        (Run(seconds=SECONDS, samples=samples(), said=said(errors={SILENT: 2}), patience=0.05), ""),
        (
            Run(seconds=SECONDS, samples=samples(), said=said(errors={SILENT: 3}), patience=0.05),
            "x (3 times)",
        ),
        (Run(seconds=SECONDS, samples=samples(), said=said(errors={"Timeout: x": 1}), patience=0.05), "Timeout: x"),
        (Run(seconds=SECONDS, samples=samples(), said=said(errors={RELAXED: 1}), patience=0.05), ""),
        (Run(seconds=SECONDS, samples=samples(), said=said(errors={FAULT: 1}), patience=0.05), "overload"),
        (Run(seconds=SECONDS, samples=samples(), said=said(), complaints=["a page was cut off"]), "cut off"),
    ],
)
def test_the_judge_knows_what_is_wrong(run: Run, says: str) -> None:
    found = judge(run).violations
    if says:
        assert any(says in violation for violation in found), found
    else:
        assert found == []


@pytest.mark.timeout(PATIENCE_S)
def test_a_short_soak_is_clean(tmp_path: Path) -> None:
    words = ["--hours", "0.008", "--parts", "head,tail", "--patience", "1", "--json", str(tmp_path / "soak.json")]
    words += ["--svg", str(tmp_path / "soak.svg")]
    ended = subprocess.run(
        [sys.executable, "-m", "tests.endurance.soak", *words],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S - 20,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    run = msgspec.json.decode((tmp_path / "soak.json").read_bytes(), type=Run)
    assert {sample.process for sample in run.samples} == {
        *("simulator", "driver", "gateway", "page", "planner head", "planner tail"),
    }
    rounds = {each.planner: each.counts.get("rounds", 0) for each in run.said}
    assert min(rounds.values()) > 0, json.dumps(rounds)
    assert run.passers > 0
    drawn = (tmp_path / "soak.svg").read_text()
    assert all(f"<!-- {name} -->" in drawn for name in ("driver", "simulator", "planner head", "tail"))
