"""S23 for the state of a motor: what it must be in before it takes a setting."""

import re
from contextlib import ExitStack
from math import inf, nan

import can
import pytest

from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.motor_rig import KINDS, ROOT
from trade.errors import DeviceSilent
from trade_drivers.vendors.damiao._frames import ENABLE

pytestmark = pytest.mark.virtual_time

NAMES = frozenset({"enable", "disable", "write_register"})


def test_S23_a_damiao_with_torque_in_another_mode_is_relaxed_before_its_mode_changes() -> None:
    with ExitStack() as undo:
        rig = KINDS["damiao"](undo)
        rig.plug()
        with rig.listen() as other:  # it comes with MIT mode, and with no time-out
            other.send(can.Message(arbitration_id=ROOT, data=ENABLE, is_extended_id=False))
        rig.wait_for("torque_on", ROOT)
        motor = rig.attach().motor("tail.root")
        mark = written_now()
        motor.enable()
        sent = [e.name for e in rig.frames(device_id=ROOT, since=mark) if e.name in NAMES]
        assert sent == ["write_register", "disable", "write_register", "enable"]  # time-out, then the mode
        assert not rig.events("motion_started", ROOT, mark)


@pytest.mark.parametrize("turns", [nan, inf, -1e30], ids=str)
def test_S23_an_odrive_that_reports_an_impossible_position_is_not_enabled(turns: float) -> None:
    """Its encoder is not ready, or not calibrated."""
    with ExitStack() as undo:
        rig = KINDS["odrive"](undo)
        rig.plug(prepare=lambda sim: setattr(sim.devices[0], "_shown", lambda _: (turns, 0.0)))
        robot = rig.attach()
        motor, other = robot.motor("tail.root"), robot.motor("tail.tip")
        for act in (motor.enable, lambda: motor.move_to(0.1), lambda: motor.set_velocity(0.1)):
            with pytest.raises(DeviceSilent, match=re.escape(f"speed or effort ({turns * 65536:.6g}, 0, 0")):
                act()
        assert not rig.commanded(ROOT)
        assert not rig.events("torque_on", ROOT)
        other.enable()
        assert other.move_to(0.1) == pytest.approx(0.1, abs=0.02)
