"""Motion ends with its session: clients are killed, frozen and interrupted; the judge is the simulator's log."""

import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import trade
from tests.support.waiting import wait_until
from tests.system.conftest import Bench, Program
from trade import where
from trade_hil_sim import events, writes

MOVER = Path(__file__).with_name("mover.py")
HALFWAY_RAD = 0.65
"""Where a joint that is not stopped gets to long after everything that stops it should have."""
SHORT_OF_GOAL_RAD = 1.2

Run = Callable[..., Program]


def moving_client(bench: Bench, run: Run, how: str) -> Program:
    since = time.monotonic()
    client = run(MOVER, how)
    client.json()
    wait_until(lambda: bool(events(bench.sim.entries(), "motion_started", device_id=1, since=since)))
    return client


def stop_delay_s(bench: Bench, run: Run, how: str, number: int) -> float:
    """The time from the end of a client in its move to the first bytes that stop the joint, by the simulator's log."""
    client = moving_client(bench, run, how)
    ended_at = time.monotonic()
    client.signal(number)
    bench.stopped_short(ended_at, SHORT_OF_GOAL_RAD)
    client.process.kill()
    return writes(bench.sim.entries(), device_id=1, register="goal_position", since=ended_at)[0].t - ended_at


@pytest.mark.parametrize(
    ("how", "number"),
    [
        ("call", signal.SIGKILL),
        ("call", signal.SIGSTOP),
        ("call", signal.SIGINT),
        ("start", signal.SIGKILL),
        ("jog", signal.SIGKILL),
        ("jog", signal.SIGSTOP),
    ],
)
def test_S05_what_a_client_moves_stops_with_it_and_nothing_else_does(
    bench: Bench, run: Run, how: str, number: int
) -> None:
    tilt = trade.find(where(name="move_to", group="rosie.neck.tilt"), wait_s=30)
    tilting = tilt.with_(deadline_s=120).start(0.55, 0.05)
    client = moving_client(bench, run, how)
    wait_until(lambda: bool(events(bench.sim.entries(), "motion_started", device_id=2)))
    ended_at = time.monotonic()
    client.signal(number)
    try:
        bench.stopped_short(ended_at, HALFWAY_RAD)
        assert not writes(bench.sim.entries(), device_id=2, register="goal_position", since=ended_at)
        assert not bench.rests("neck.tilt")
        assert not tilting.done()
    finally:
        client.process.kill()


@pytest.mark.parametrize("killed", ["plan", "relay"])
def test_S03_a_motion_ends_with_any_session_on_whose_behalf_it_is(bench: Bench, run: Run, killed: str) -> None:
    relay = run(MOVER, "relay")
    relay.json()
    planner = moving_client(bench, run, "plan")
    ended_at = time.monotonic()
    (planner if killed == "plan" else relay).signal(signal.SIGKILL)
    bench.stopped_short(ended_at, HALFWAY_RAD)


@pytest.fixture
def local_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """What starts after this uses the local path, also where the whole run does not."""
    monkeypatch.delenv("TRADE_LOCAL_PATH", raising=False)


def test_S05_a_joint_stops_no_later_where_calls_take_the_local_path(
    local_path: None, bench: Bench, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def delays_s() -> tuple[float, float, float]:
        return (
            min(stop_delay_s(bench, run, "call", signal.SIGKILL) for _ in range(3)),
            stop_delay_s(bench, run, "leave", signal.SIGTERM),
            stop_delay_s(bench, run, "call", signal.SIGSTOP),
        )

    killed_s, left_s, frozen_s = delays_s()
    forked_s = stop_delay_s(bench, run, "forked", signal.SIGKILL)
    bench.driver.close()
    monkeypatch.setenv("TRADE_LOCAL_PATH", "0")
    bench.restart()
    killed_without_s, left_without_s, lease_s = delays_s()
    assert killed_s < killed_without_s + lease_s / 4
    assert left_s < left_without_s + lease_s / 4
    assert frozen_s < lease_s * 1.5
    assert forked_s < lease_s / 2  # its child keeps the sockets of the transport open
