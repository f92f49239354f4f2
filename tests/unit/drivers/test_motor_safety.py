"""The rules of motion for ODrives and Damiao motors, judged on frames: the numbers are those of docs/safety.md."""

from collections.abc import Callable

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.motor_rig import ROOT, MotorRig, motor_rig, wag
from trade import Container, where
from trade.errors import (
    DeviceFault,
    TradeError,
)
from trade_drivers import Motor
from trade_hil_sim import Replug, Unplug

__all__ = ["motor_rig", "wag"]


def test_S05_a_motion_ends_with_its_session(wag: MotorRig, start_container: Callable[..., Container]) -> None:
    driver = start_container("driver")
    wag.attach(register=driver.register, deregister=driver.deregister)
    planner = start_container("planner")
    move = planner.find(where(name="move_to", group="rosie.tail.root"), wait_s=20).with_(deadline_s=60)
    move.start(0.9, 0.1)
    began = wag.wait_for("motion_started", ROOT)
    planner.close()
    wag.wait_for("at_rest", ROOT, began.t)
    assert wag.truth(ROOT).position_rad < 0.8


# --- attaching and leaving


def test_S18_replugging_never_enables_and_never_commands(wag: MotorRig) -> None:
    robot = wag.attach()
    root = robot.motor("tail.root")
    root.move_to(0.3)
    wag.sim.do(Unplug())
    wait_until(lambda: not answers(root), "the driver noticed")
    mark = written_now()
    wag.sim.do(Replug())
    wait_until(lambda: answers(root) and answers(robot.motor("tail.tip")), "the driver is back")
    with pytest.raises(DeviceFault):
        root.move_to(0.0)
    assert not wag.commanded(since=mark)
    assert not wag.events("motion_started", since=mark)
    assert not wag.events("torque_on", since=mark)


def test_S19_leaving_while_moving_stops_first_and_relaxes(wag: MotorRig) -> None:
    robot = wag.attach()
    root = robot.motor("tail.root")
    root.enable()
    mark = written_now()
    moving = Outcome(lambda: root.move_to(0.9, 0.3))
    wag.wait_for("motion_started", ROOT, mark)
    robot.close()
    assert isinstance(moving.wait().error, TradeError)
    rest, off = wag.wait_for("at_rest", ROOT, mark), wag.wait_for("torque_off", ROOT, mark)
    assert rest.position_rad is not None
    assert off.position_rad is not None
    assert abs(rest.position_rad - off.position_rad) < 0.002  # it did not coast: its speed was nothing when it let go
    assert wag.truth(ROOT).position_rad < 0.8


def answers(motor: Motor) -> bool:
    try:
        motor.state()
    except TradeError:
        return False
    return True
