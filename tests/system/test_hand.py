"""``trade up examples/hand.toml --sim``: a gripper from the command line and from another process."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.system.conftest import ROOT
from trade import Container, where
from trade.errors import DeviceFault
from trade_hil_sim import SimControl, motion_writes, read_log


@pytest.mark.slow
def test_the_example_comes_up_is_activated_by_hand_and_grips(
    run: Callable[..., Any],
    trade_command: Callable[..., subprocess.CompletedProcess[str]],
    start_container: Callable[..., Container],
    tmp_path: Path,
) -> None:
    log = tmp_path / "bytes.jsonl"
    up = run("-m", "trade_gateway", "up", ROOT / "examples" / "hand.toml", "--sim", "--sim-log", log, "--json")
    ready = up.json()
    assert "rosie.left.hand.activate" in ready["services"]
    planner = start_container("planner")

    def hand(name: str) -> Any:
        return planner.find(where(name=name, group="rosie.left.hand"), wait_s=20).with_(deadline_s=60)

    with planner.lock(where(group="rosie")):
        with pytest.raises(DeviceFault, match=r"call activate\(\)"):
            hand("close")()
        assert not motion_writes(read_log(log))
        with SimControl(ready["control"]) as control:
            control.put(0.04)
            assert hand("activate")().activated
            state = hand("close")()
            assert (state.holding, control.gripper("left.hand").holding) == ("outside", True)
            assert state.width_m == pytest.approx(0.04, abs=0.003)
    reported = trade_command("call", "rosie.left.hand.state", "--json")
    assert reported.returncode == 0, reported.stderr
    assert '"holding"' in reported.stdout
