"""The contracts of all kinds of devices, on simulated Feetech servos."""

from collections.abc import Iterator

import pytest

from tests.unit.drivers.tail_rig import tail_rig
from trade_drivers import AttachedRobot, JointGroup, Motor
from trade_drivers.testing import JointGroupContract, MotorContract


@pytest.fixture(scope="module", autouse=True)
def tail(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttachedRobot]:
    with tail_rig(tmp_path_factory.mktemp("tail")) as rig:
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
