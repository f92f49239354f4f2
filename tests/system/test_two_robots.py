"""Two robots, two driver processes, one lock: all of it or nothing, however often a driver is killed."""

import os
import random
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.system.conftest import DORA, ROSIES_HEAD, Bench
from trade import Container, where
from trade.errors import ContainerLost, IncompleteGroup, LockedByOther, LockLost, ServiceGone, TradeError
from trade_hil_sim import events, writes

ROUNDS = int(os.environ.get("CHAOS_ROUNDS", "5"))
BOTH = where(group="rosie") | where(group="dora")
pytestmark = [pytest.mark.timeout(120 + 20 * ROUNDS)]


@pytest.fixture
def rosie(benches: Callable[[Path], Bench]) -> Bench:
    return benches(ROSIES_HEAD)


@pytest.fixture
def dora(benches: Callable[[Path], Bench]) -> Bench:
    return benches(DORA)


def whole(container: Container) -> bool:
    """Whether both robots are there with all their joints."""
    moves = container.services(BOTH & where(name="move_to"))
    return len({name for handle in moves for name in handle.resources}) == 2 + 6


def test_S16_the_two_arms_are_one_group_although_they_share_no_bus(
    dora: Bench, start_container: Callable[..., Container]
) -> None:
    planner, operator = start_container("planner"), start_container("operator")
    shoulder = operator.find(where(name="move_to", group="dora.right.shoulder"), wait_s=30)
    planner.find(where(name="move_to", group="dora.right.shoulder"), wait_s=30)
    with planner.lock(where(group="dora.arms")) as lock:
        assert lock.resources == tuple(
            sorted(f"dora.{side}.{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow"))
        )
        with pytest.raises(LockedByOther):
            shoulder(0.1)
    assert not writes(dora.sim.entries(), register="goal_position")
    shoulder(0.1)


def test_S14_a_lock_over_two_robots_is_all_or_nothing_while_a_driver_dies_again_and_again(
    rosie: Bench, dora: Bench, start_container: Callable[..., Container]
) -> None:
    planner, other = start_container("planner"), start_container("other")
    chance = random.Random(14)
    for _ in range(ROUNDS):
        wait_until(lambda: whole(planner) and whole(other))
        both = [handle for handle in planner.services(BOTH) if handle.effect == "actuate"]
        _lose_them_while_moving(rosie, dora, planner, chance.uniform(0.0, 0.3))
        with pytest.raises(TradeError) as refused:
            planner.lock(both, wait_s=0.5).acquire()
        assert isinstance(refused.value, ServiceGone | ContainerLost | IncompleteGroup | LockedByOther), refused.value
        with other.lock(where(group="rosie"), wait_s=10) as free:  # nothing of it stayed behind
            assert free.resources == ("rosie.neck.pan", "rosie.neck.tilt")
        dora.restart()
    wait_until(lambda: whole(planner))
    with planner.lock(BOTH, wait_s=10) as lock:
        assert len(lock.resources) == 2 + 6


def _lose_them_while_moving(rosie: Bench, dora: Bench, planner: Container, after_s: float) -> None:
    reported: list[LockLost] = []
    lock = planner.lock(BOTH, wait_s=20, on_lost=reported.append).acquire()
    with lock.use():
        moving = planner.find(where(name="move_to", group="rosie.neck.pan")).with_(deadline_s=120)
        before = len(events(rosie.sim.entries(), "motion_started", device_id=1))
        began = rosie.sim.entries()[-1].t
        run = moving.start(-1.3 if before % 2 else 1.3, 0.1)
        wait_until(lambda: len(events(rosie.sim.entries(), "motion_started", device_id=1)) > before)
        threading.Event().wait(after_s)
        dora.driver.signal(signal.SIGKILL)
        dora.driver.wait()
        wait_until(lambda: bool(reported))
        wait_until(lambda: bool(rosie.rests("neck.pan", began)))
        assert abs(rosie.rests("neck.pan", began)[0]) < 1.2
        assert run.exception(60) is not None
        with pytest.raises(LockLost):
            moving(0.0)
    lock.release()
