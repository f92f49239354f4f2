"""The clock on the wall is set by hours and by years, while calls, locks, motion, notifications and streams go on.

Two processes of one host have that clock; what is here is another host, whose clock is right.
"""

import json
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.c_compiler import library
from tests.support.waiting import wait_until
from tests.system.conftest import Program, Rosie
from trade import Container, where
from trade.errors import LockedByOther

HERE = Path(__file__).parent
HOUR_S = 3600
YEARS_S = 400 * 24 * HOUR_S
ROUNDS = 5
NEAR_S = HOUR_S // 2


class Wall:
    """The clock of processes that are started from now on."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "wall"
        self.set(0)

    def set(self, ahead_s: int) -> None:
        self.ahead_s = ahead_s
        with self.file.open("r+b" if self.file.exists() else "w+b") as file:
            file.write(struct.pack("q", ahead_s))

    def shown_by(self, said: dict[str, Any]) -> bool:
        """Whether a process said that after it was set."""
        return abs(said["wall_s"] - time.time() - self.ahead_s) < NEAR_S


@pytest.fixture
def wall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Wall:
    made = Wall(tmp_path)
    monkeypatch.setenv("WALL_CLOCK", str(made.file))
    monkeypatch.setenv("LD_PRELOAD", str(library(HERE / "wall.c", tmp_path / "wall.so")))
    return made


@pytest.mark.slow
def test_no_lock_is_lost_no_call_fails_and_the_record_stays_whole(
    wall: Wall,
    rosie_up: Callable[[], Rosie],
    run: Callable[..., Program],
    start_container: Callable[..., Container],
    trade_command: Callable[..., "subprocess.CompletedProcess[str]"],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TRADE_AUDIT", str(tmp_path / "audit"))
    rosie_up()
    elsewhere = start_container("elsewhere")
    state = elsewhere.find(where(name="state", group="rosie.neck.pan"), wait_s=30)
    move = elsewhere.find(where(name="move_to", group="rosie.neck.pan"), wait_s=30)
    holder = run(HERE / "holder.py")
    holder.json()
    elsewhere.set_tracing(True)
    steps = (5 * HOUR_S, -9 * HOUR_S, YEARS_S, 0)
    for ahead_s in steps:
        wall.set(ahead_s)
        before = holder.wait_for(wall.shown_by)
        for _ in range(ROUNDS):
            said = holder.json()
            assert (said["held"], said["lost"], said["after"]) == (True, [], True)
        assert said["ticks"] > before["ticks"]
        assert said["samples"] > before["samples"]
        assert state().name == "rosie.neck.pan"
        assert state().age_s < 5
        with pytest.raises(LockedByOther, match="hold"):
            move(0.2)

    def rows(*words: str) -> list[dict[str, Any]]:
        done = trade_command("audit", "--json", *words)
        assert done.returncode == 0, done.stderr
        return [json.loads(line) for line in done.stdout.splitlines()]

    wait_until(lambda: len(rows("--kind", "audit", "--service", "clock set", "--container", "rosie")) == len(steps))
    assert {row["outcome"] for row in rows("--kind", "call")} == {"ok"}
    assert [row["what"] for row in rows("--kind", "lock")] == ["locked"]
    assert trade_command("audit", "verify").returncode == 0
    spans = elsewhere.spans(container="holder")
    asked = [span for span in spans if (span.side, span.service) == ("asked", "rosie.neck.pan.move_to")]
    trace = elsewhere.trace(asked[-1].call_id)
    assert trace.served is not None
    assert trace.served.outcome == "ok"
    assert 0 < trace.served.took_s <= asked[-1].took_s < 60
