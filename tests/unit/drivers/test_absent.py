"""A device that does not answer at the start is absent: another error than for one that is wrong, since it may come."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import dynamixel_sdk  # noqa: F401 - virtual time misses its first import
import pymodbus.client  # noqa: F401 - the same
import pytest

from tests.unit.drivers.conftest import Rig
from tests.unit.drivers.gripper_rig import HandRig
from tests.unit.drivers.motor_rig import KINDS
from tests.unit.drivers.tail_rig import TailRig
from trade.errors import ConfigurationError, DeviceAbsent
from trade_hil_sim import Absent, Servo, motion_writes

pytestmark = pytest.mark.virtual_time

RIGS: dict[str, Callable[[Path, ExitStack], Any]] = {
    "dynamixel": Rig,
    "feetech": TailRig,
    "robotiq": HandRig,
    "odrive": lambda _, undo: KINDS["odrive"](undo),
    "damiao": lambda _, undo: KINDS["damiao"](undo),
}


@pytest.fixture(params=RIGS)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    with ExitStack() as undo:
        yield RIGS[request.param](tmp_path, undo)


def first_id(rig: Any) -> int:
    return (*rig.robot.joints, *rig.robot.grippers)[0].id  # type: ignore[no-any-return]


def test_a_device_without_power_is_absent_and_is_attached_once_it_has_some(rig: Any) -> None:
    rig.plug()
    ids = (first_id(rig),)
    rig.sim.do(Absent(ids=ids))
    with pytest.raises(DeviceAbsent):
        rig.attach()
    rig.sim.do(Absent(ids=ids, on=False))
    assert rig.attach()
    assert not motion_writes(list(rig.sim.log.entries))


def test_a_port_that_does_not_exist_is_absent(rig: Any) -> None:
    rig.plug()
    bus = rig.robot.buses[0].name
    with pytest.raises(DeviceAbsent):
        rig.attach(ports={bus: "socketcand:127.0.0.1:9/can0" if ":" in str(rig.sim.port) else "/dev/ttyNOWHERE"})


def test_two_devices_of_one_id_are_wrong_and_not_absent(tmp_path: Path) -> None:
    with ExitStack() as undo:
        rig = Rig(tmp_path, undo)
        rig.plug(Servo(1), Servo(1), Servo(2))
        with pytest.raises(ConfigurationError, match="two devices may share this id") as error:
            rig.attach()
        assert not isinstance(error.value, DeviceAbsent)
        assert not motion_writes(rig.log)
