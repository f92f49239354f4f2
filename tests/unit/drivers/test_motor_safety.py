"""The rules of motion for ODrives and Damiao motors, judged on frames: the numbers are those of docs/safety.md."""

import pytest

from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.motor_rig import ROOT, MotorRig, motor_rig, wag
from trade.errors import (
    TradeError,
)

pytestmark = pytest.mark.virtual_time

__all__ = ["motor_rig", "wag"]


def test_S19_shutdown_while_moving_stops_first_and_relaxes(wag: MotorRig) -> None:
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
