"""Contract tests for drivers, one class per kind of device, run by pytest on simulated and real devices.

The contracts are plain classes with ``test_`` methods. A subclass provides the tested device as a fixture.
``python -m trade_drivers.testing --hil ROBOT.toml`` runs them on the devices of a robot file.

``FakeJointGroup`` is a test double for programs that use a robot.
"""

from trade_drivers.testing._arms import ArmContract
from trade_drivers.testing._cameras import CameraContract
from trade_drivers.testing._fakes import FakeJointGroup
from trade_drivers.testing._grippers import GripperContract
from trade_drivers.testing._groups import JointGroupContract
from trade_drivers.testing._motors import MotorContract
from trade_drivers.testing._sensors import SensorContract

__all__ = [
    "ArmContract",
    "CameraContract",
    "FakeJointGroup",
    "GripperContract",
    "JointGroupContract",
    "MotorContract",
    "SensorContract",
]
