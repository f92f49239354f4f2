"""The contracts that `_hil` runs with pytest, for all devices of the robot file."""

from trade_drivers.testing._arms import ArmContract
from trade_drivers.testing._cameras import CameraContract
from trade_drivers.testing._grippers import GripperContract
from trade_drivers.testing._groups import JointGroupContract
from trade_drivers.testing._motors import MotorContract
from trade_drivers.testing._sensors import SensorContract


class TestMotor(MotorContract):
    """Each joint."""


class TestJointGroup(JointGroupContract):
    """Each group."""


class TestGripper(GripperContract):
    """Each gripper."""


class TestArm(ArmContract):
    """Each arm."""


class TestCamera(CameraContract):
    """Each camera."""


class TestSensor(SensorContract):
    """Each sensor."""
