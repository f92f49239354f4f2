"""A bridge between TRADE and ROS: topics, services, actions and joints of each side, offered on the other."""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from trade_gateway.ros._bridge import Bridge, Bridged
    from trade_gateway.ros._connect import join, planned
    from trade_gateway.ros._file import RosFile, read_ros_file

__all__ = ["Bridge", "Bridged", "RosFile", "join", "planned", "read_ros_file"]

_PLACES: Final = {
    "Bridge": "_bridge",
    "Bridged": "_bridge",
    "join": "_connect",
    "planned": "_connect",
    "RosFile": "_file",
    "read_ros_file": "_file",
}
"""The modules of these names; they need the extra ``ros``, which the command line is installed without."""


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(name)
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
