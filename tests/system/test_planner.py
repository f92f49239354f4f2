"""The planner's story, as a user runs it: three processes, and the camera is not linked to the others at first."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.conftest import Program
from trade import Container, where
from trade.transport.endpoints import free_endpoint

PLANNER = Path(__file__).parents[2] / "examples" / "planner.py"


def test_a_planner_without_a_camera_finds_a_provider_that_can_see(
    run: Callable[..., Program], monkeypatch: pytest.MonkeyPatch, start_container: Callable[..., Container]
) -> None:
    arm = run(PLANNER, "arm")
    assert arm.line() == "arm: rosie.arm.unfold, rosie.arm.pick_up\n"
    alone = free_endpoint()
    with monkeypatch.context() as apart:
        apart.setenv("TRADE_LISTEN", alone)
        apart.setenv("TRADE_CONNECT", alone)
        assert run(PLANNER, "camera").line() == "camera: rosie.eyes.check_for\n"
    bystander = start_container("bystander")
    bystander.find(where(name="pick_up"), wait_s=30)
    assert bystander.services(where(achieves="see(mug)")) == []

    planner = run(PLANNER, "planner", "holding(mug)")
    assert planner.lines() == [
        "planner: no plan for holding(mug): no healthy service of rosie achieves see(mug); searching\n",
        "planner: rosie.eyes.check_for has joined in container camera\n",
        "planner: plan: rosie.eyes.check_for(mug), rosie.arm.unfold(), rosie.arm.pick_up(place=<see(mug)>)\n",
        "planner: rosie.eyes.check_for: see(mug)\n",
        "planner: rosie.arm.unfold: unfolded(arm)\n",
        "planner: rosie.arm.pick_up: holding(mug)\n",
        "planner: holding(mug)\n",
    ]
    assert [arm.line() for _ in range(2)] == ["arm: unfolding\n", "arm: picking up at +0.4 m, -0.1 m\n"]
