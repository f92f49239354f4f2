"""The contracts of all kinds of devices, on simulated ODrives and Damiao motors."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from tests.unit.drivers.motor_rig import KINDS
from trade_drivers import AttachedRobot, JointGroup, Motor
from trade_drivers.testing import JointGroupContract, MotorContract


@pytest.fixture(scope="module", params=list(KINDS), autouse=True)
def tail(request: pytest.FixtureRequest) -> Iterator[AttachedRobot]:
    with ExitStack() as undo:
        rig = KINDS[request.param](undo)
        rig.plug()
        yield rig.attach()


class TestMotor(MotorContract):
    @pytest.fixture(params=["tail.root", "tail.tip"])
    def motor(self, request: pytest.FixtureRequest, tail: AttachedRobot) -> Iterator[Motor]:
        motor = tail.motor(request.param)
        yield motor
        motor.relax()


class TestJointGroup(JointGroupContract):
    @pytest.fixture
    def group(self, tail: AttachedRobot) -> Iterator[JointGroup]:
        group = tail.group("tail")
        yield group
        group.relax()
