"""Motors, grippers, arms, cameras and sensors as TRADE services: interfaces in SI units, robot file, drivers."""

from trade_drivers._arm import Arm, ArmLimits, ArmState
from trade_drivers._attach import AttachedRobot, attach
from trade_drivers._can_monitor import CanBusState, CanMonitor
from trade_drivers._commission import Bench, Commissioner, Found, scan
from trade_drivers._driver import AnyDriver, AttachedBus, Driver, SenseDriver, drivers, load_driver
from trade_drivers._interfaces import Gripper, GripperLimits, GripperState, JointGroup, Motor, MotorState
from trade_drivers._load import load
from trade_drivers._plan import FollowProgress, JointLimits, Plan, Tolerances
from trade_drivers._polled import Measured, PolledSensor
from trade_drivers._refusals import check, refusals
from trade_drivers._senses import UNITS, Camera, CameraInfo, Image, Reading, Sensor, SensorInfo
from trade_drivers._trajectory import Trajectory, TrajectoryPoint, planned
from trade_drivers._without import without
from trade_drivers._work import WireError
from trade_drivers.faults import Fault, FaultInfo, FaultLog, FaultSample, Trouble
from trade_drivers.robotfile import Bus, CanBus, Coupled, Group, Joint, Robot, SerialBus, UrBus, parse

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
    "FollowProgress",
    "Found",
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
    "SenseDriver",
    "Sensor",
    "SensorInfo",
    "SerialBus",
    "Tolerances",
    "Trajectory",
    "TrajectoryPoint",
    "Trouble",
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
