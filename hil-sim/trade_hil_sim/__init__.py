"""Simulated devices that speak the real bytes, on pseudo-terminals, with a byte log and scripted faults.

`SimProcess` simulates a whole robot file in a process of its own, `SimThreads` in threads of this one;
`trade_hil_sim.dynamixel` has single devices. `read_log`, `motion_writes` and similar functions query what a bus has
seen.
"""

from trade_hil_sim.control._client import SimControl
from trade_hil_sim.control._process import SimProcess, remove_leftovers
from trade_hil_sim.control._threads import SimThreads
from trade_hil_sim.faults._commands import (
    Absent,
    AnswerFault,
    BadCrc,
    BrownOut,
    BusOff,
    Command,
    Dribble,
    Duplicate,
    Echo,
    Emergency,
    Freeze,
    Garbage,
    HangUp,
    HardwareFault,
    Heal,
    Jam,
    Late,
    Local,
    Mute,
    Place,
    Put,
    Replug,
    SimulationError,
    Supply,
    Truncate,
    Unmute,
    Unplug,
    WrongModel,
)
from trade_hil_sim.log._byte_log import ByteLog, LogEntry
from trade_hil_sim.log._queries import (
    Span,
    events,
    frames,
    instructions,
    motion_writes,
    read_log,
    received,
    sent,
    writes,
)
from trade_hil_sim.mechanics._truth import ArmTruth, BusState, DeviceState, GripperTruth
from trade_hil_sim.serial._line import Peer, SerialLine

from .can import CanBus, Frame
from .dynamixel import MODELS, XL430_W250, XM430_W350, DynamixelBus, Servo
from .robotiq import Gripper, RobotiqBus
from .scene import SceneCamera
from .ur import Arm, UrBus

__all__ = [
    "MODELS",
    "XL430_W250",
    "XM430_W350",
    "Absent",
    "AnswerFault",
    "Arm",
    "ArmTruth",
    "BadCrc",
    "BrownOut",
    "BusOff",
    "BusState",
    "ByteLog",
    "CanBus",
    "Command",
    "DeviceState",
    "Dribble",
    "Duplicate",
    "DynamixelBus",
    "Echo",
    "Emergency",
    "Frame",
    "Freeze",
    "Garbage",
    "Gripper",
    "GripperTruth",
    "HangUp",
    "HardwareFault",
    "Heal",
    "Jam",
    "Late",
    "Local",
    "LogEntry",
    "Mute",
    "Peer",
    "Place",
    "Put",
    "Replug",
    "RobotiqBus",
    "SceneCamera",
    "SerialLine",
    "Servo",
    "SimControl",
    "SimProcess",
    "SimThreads",
    "SimulationError",
    "Span",
    "Supply",
    "Truncate",
    "Unmute",
    "Unplug",
    "UrBus",
    "WrongModel",
    "events",
    "frames",
    "instructions",
    "motion_writes",
    "read_log",
    "received",
    "remove_leftovers",
    "sent",
    "writes",
]
