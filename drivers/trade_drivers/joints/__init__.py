"""The common base of drivers for joints with a position drive, with one owner thread per bus."""

from trade_drivers.bus._jobs import AwaitedJob, Gate, PortLost, Steps
from trade_drivers.bus._thread import BusThread, Port, start_thread
from trade_drivers.joints._axis import Axis, AxisMotion, AxisT, Goal, Resolution, Sample
from trade_drivers.joints._cycle import ControlMode, Exchange, Motion
from trade_drivers.joints._inspect import DeviceUnusable, check_joints, check_least, check_rate
from trade_drivers.joints._motor import AttachedJoints, BusMotor
from trade_drivers.joints._ramp import Ramp, towards
from trade_drivers.joints._waiting import next_measurement, until

__all__ = [
    "AttachedJoints",
    "AwaitedJob",
    "Axis",
    "AxisMotion",
    "AxisT",
    "BusMotor",
    "BusThread",
    "ControlMode",
    "DeviceUnusable",
    "Exchange",
    "Gate",
    "Goal",
    "Motion",
    "Port",
    "PortLost",
    "Ramp",
    "Resolution",
    "Sample",
    "Steps",
    "check_joints",
    "check_least",
    "check_rate",
    "next_measurement",
    "start_thread",
    "towards",
    "until",
]
