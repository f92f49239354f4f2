"""Simulated servo drives on CANopen: CiA 301 and CiA 402, written by hand from the standards."""

from ._bus import Cia402Bus
from ._drive import Drive
from ._machine import Command, State, command, next_state
from ._modes import Mode
from ._node import NodeState
from ._objects import OBJECTS, Object, pdo_objects
from ._sdo import SdoServer
from ._store import Abort, AbortCode, Store
from ._units import factor_objects, unit_objects

__all__ = [
    "OBJECTS",
    "Abort",
    "AbortCode",
    "Cia402Bus",
    "Command",
    "Drive",
    "Mode",
    "NodeState",
    "Object",
    "SdoServer",
    "State",
    "Store",
    "command",
    "factor_objects",
    "next_state",
    "pdo_objects",
    "unit_objects",
]
