"""Motors, grippers, arms, cameras and sensors as TRADE services: interfaces in SI units, robot file, drivers."""

from trade.protocol.schema_types import publish as _publish
from trade_drivers._attach import AttachedRobot, attach
from trade_drivers._robot_file import load, parse, without
from trade_drivers.bus._can_monitor import CanBusState, CanMonitor
from trade_drivers.bus._jobs import WireError
from trade_drivers.commissioning._commissioner import Bench, Commissioner, ScannedDevice, scan
from trade_drivers.faults import Fault, FaultInfo, FaultLog, FaultSample, FaultUpdate
from trade_drivers.interfaces._arm import Arm, ArmLimits, ArmState
from trade_drivers.interfaces._motion import Gripper, GripperLimits, GripperState, JointGroup, Motor, MotorState
from trade_drivers.interfaces._polled_sensor import Measured, PolledSensor
from trade_drivers.interfaces._sensing import UNITS, Camera, CameraInfo, Image, Reading, Sensor, SensorInfo
from trade_drivers.interfaces._trajectory import Trajectory, TrajectoryPoint, planned
from trade_drivers.motion._plan import FollowProgress, JointLimits, Plan, Tolerances
from trade_drivers.plugins._driver import AnyDriver, AttachedBus, Driver, SenseDriver, drivers, load_driver
from trade_drivers.plugins._validate import check, refusals
from trade_robotfile import Bus, CanBus, Coupled, Group, Joint, Robot, SerialBus, UrBus

__all__ = [
    "UNITS",
    "AnyDriver",
    "Arm",
    "ArmLimits",
    "ArmState",
    "AttachedBus",
    "AttachedRobot",
    "Bench",
    "Bus",
    "Camera",
    "CameraInfo",
    "CanBus",
    "CanBusState",
    "CanMonitor",
    "Commissioner",
    "Coupled",
    "Driver",
    "Fault",
    "FaultInfo",
    "FaultLog",
    "FaultSample",
    "FaultUpdate",
    "FollowProgress",
    "Gripper",
    "GripperLimits",
    "GripperState",
    "Group",
    "Image",
    "Joint",
    "JointGroup",
    "JointLimits",
    "Measured",
    "Motor",
    "MotorState",
    "Plan",
    "PolledSensor",
    "Reading",
    "Robot",
    "ScannedDevice",
    "SenseDriver",
    "Sensor",
    "SensorInfo",
    "SerialBus",
    "Tolerances",
    "Trajectory",
    "TrajectoryPoint",
    "UrBus",
    "WireError",
    "attach",
    "check",
    "drivers",
    "load",
    "load_driver",
    "parse",
    "planned",
    "refusals",
    "scan",
    "without",
]

_publish(
    __name__, ArmLimits, ArmState, CameraInfo, CanBusState, Fault, FaultInfo, FaultSample, GripperLimits, GripperState
)
_publish(__name__, Image, JointLimits, MotorState, Reading, SensorInfo)
