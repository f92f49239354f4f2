import threading
import time
from collections.abc import Iterator

import pytest
from lookout import Lookout

from pytest_trade_hil_sim.robots import SimulatedRobot, StartRobot
from trade_hil_sim import events, motion_writes

MINUTE_S = 60.0


@pytest.fixture
def robot(simulated_robot: StartRobot) -> SimulatedRobot:
    return simulated_robot("head.toml", rate_hz=12)


@pytest.fixture
def lookout(robot: SimulatedRobot) -> Iterator[Lookout]:
    made = Lookout(robot.client("mind"))
    running = threading.Thread(target=made.run)
    running.start()
    yield made
    made.ended.set()
    running.join()


@pytest.mark.virtual_time(seed=1, packages=["lookout"])
def test_after_a_brown_out_it_waits_for_a_person_and_continues(robot: SimulatedRobot, lookout: Lookout) -> None:
    robot.fault_at(5 * MINUTE_S, "brown_out ids=1")
    time.sleep(4 * MINUTE_S)
    assert not lookout.problem

    time.sleep(2 * MINUTE_S)
    assert "rosie.neck.pan" in lookout.problem
    looked = time.monotonic()
    robot.client("operator").robot("rosie").head.enable()

    time.sleep(4 * MINUTE_S)
    assert not lookout.problem
    assert abs(robot.control.device("neck.pan").position_rad) == pytest.approx(0.5, abs=0.01)
    [died] = events(robot.log(), "brown_out")
    moves = [write.t for write in motion_writes(robot.log(), device_id=1)]
    assert any(moved < died.t for moved in moves)
    assert not any(died.t < moved < looked for moved in moves)
