"""Tests of devices and without devices: a contract for each kind of device, and fake devices.

The contracts are for drivers: plain classes with ``test_`` methods that pytest runs on simulated and real devices. A
subclass provides the tested device as a fixture. ``python -m trade_drivers.testing --hil ROBOT.toml`` runs them on the
devices of a robot file.

``FakeMotor``, ``FakeJointGroup``, ``FakeGripper``, ``FakeArm``, ``FakeCamera`` and ``FakeSensor`` are test doubles for
programs that use a robot.
"""

from trade_drivers.testing._arms import ArmContract
from trade_drivers.testing._cameras import CameraContract
from trade_drivers.testing._fake_arm import FakeArm
from trade_drivers.testing._fake_gripper import FakeGripper
from trade_drivers.testing._fake_joints import FakeJointGroup, FakeMotor
from trade_drivers.testing._fake_senses import FakeCamera, FakeSensor
from trade_drivers.testing._grippers import GripperContract
from trade_drivers.testing._groups import JointGroupContract
from trade_drivers.testing._motors import MotorContract
from trade_drivers.testing._sensors import SensorContract

__all__ = [
    "ArmContract",
    "CameraContract",
    "FakeArm",
    "FakeCamera",
    "FakeGripper",
    "FakeJointGroup",
    "FakeMotor",
    "FakeSensor",
    "GripperContract",
    "JointGroupContract",
    "MotorContract",
    "SensorContract",
]
