"""Joints with a position drive on a bus: what drivers of every vendor have in common, one owner thread a bus."""

from trade_drivers.bus._jobs import Gate, PortLost, Steps
from trade_drivers.bus._thread import BusThread, Port
from trade_drivers.joints._axis import Axis, Goal, Grain, Sample
from trade_drivers.joints._cycle import Exchange
from trade_drivers.joints._jobs import Job, Manner
from trade_drivers.joints._motion import Motion
from trade_drivers.joints._motor import AttachedJoints, BusMotor
from trade_drivers.joints._ramp import Ramp, towards
from trade_drivers.joints._waiting import next_measurement, until

__all__ = [
    "AttachedJoints",
    "Axis",
    "BusMotor",
    "BusThread",
    "Exchange",
    "Gate",
    "Goal",
    "Grain",
    "Job",
    "Manner",
    "Motion",
    "Port",
    "PortLost",
    "Ramp",
    "Sample",
    "Steps",
    "next_measurement",
    "towards",
    "until",
]
