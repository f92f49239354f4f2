"""What every driver must do: a contract for each kind of device, run by pytest on its simulation and on hardware.

The contracts are plain classes with ``test_`` methods, run in a subclass that says by a fixture what is tested.
``python -m trade_drivers.testing --hil ROBOT.toml`` runs them on the devices of a robot file.

``FakeJointGroup`` stands for a robot in tests of what uses one.
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
