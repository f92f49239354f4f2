"""The processes of a robot: in real time with devices, ordinary in a simulation or on request."""

import os
import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest

from tests.bench._fifo import threads_of
from tests.system.conftest import ROSIES_HEAD, Program
from trade_gateway.process._real_time import refusal
from trade_hil_sim import SimProcess

pytestmark = [pytest.mark.skipif(bool(refusal()), reason=refusal() or "it may")]


@pytest.mark.parametrize(
    ("words", "policies"),
    [((), {os.SCHED_FIFO}), (("--no-real-time",), {os.SCHED_OTHER}), (("--sim",), {os.SCHED_OTHER})],
    ids=["devices", "devices, on request ordinary", "simulation"],
)
def test_a_robot_with_devices_runs_in_real_time(
    run: Callable[..., Program], tmp_path: Path, words: tuple[str, ...], policies: set[int]
) -> None:
    with ExitStack() as undo:
        file = ROSIES_HEAD
        if "--sim" not in words:
            ports = undo.enter_context(SimProcess(ROSIES_HEAD)).ports
            file = tmp_path / "rosie.toml"
            file.write_text(re.sub("(?m)^port = .*", f'port = "{ports["neck"]}"', ROSIES_HEAD.read_text()))
        up = run("-m", "trade_gateway", "up", file, *words, "--json")
        up.json()
        process = psutil.Process(up.process.pid)
        pids = [one.pid for one in (process, *process.children(recursive=True))]
        assert {os.sched_getscheduler(thread) for pid in pids for thread in threads_of(pid)} == policies
