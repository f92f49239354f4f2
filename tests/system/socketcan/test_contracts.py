"""The contracts of motors and groups, on drives behind an interface of the system."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from tests.unit.drivers.legs import PATIENT, Leg
from trade_drivers import AttachedRobot, JointGroup, Motor
from trade_drivers.testing import JointGroupContract, MotorContract


@pytest.fixture(scope="module", autouse=True)
def robot(interface: str) -> Iterator[AttachedRobot]:
    with ExitStack() as undo:
        leg = Leg(undo, interface, rate_hz=30)  # a position takes three cycles, and is followed for 0.2 s at most
        leg.configure(PATIENT)
        leg.plug()
        yield leg.attach()


class TestMotor(MotorContract):
    @pytest.fixture(params=["leg.knee"])
    def motor(self, request: pytest.FixtureRequest, robot: AttachedRobot) -> Iterator[Motor]:
        motor = robot.motor(request.param)
        yield motor
        motor.relax()


class TestJointGroup(JointGroupContract):
    @pytest.fixture
    def group(self, robot: AttachedRobot) -> Iterator[JointGroup]:
        group = robot.group("leg")
        yield group
        group.relax()
