"""S23 for the state of a motor: what it must be in before it takes a setting."""

from contextlib import ExitStack

import can
import pytest

from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.motor_rig import KINDS, ROOT
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
