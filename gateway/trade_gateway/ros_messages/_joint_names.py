"""The names of joints in ROS."""

from collections.abc import Mapping, Sequence
from typing import Final

from trade.errors import ConfigurationError


class JointNames:
    """The names of joints in ROS and in TRADE.

    Args:
        joints: full names in TRADE.
        short: whether the ROS names are the last parts of the TRADE names.
        named: for each other ROS name, the TRADE name.

    Raises:
        ConfigurationError: two joints would have the same name, or a name belongs to no joint.
    """

    def __init__(self, joints: Sequence[str], *, short: bool, named: Mapping[str, str]) -> None:
        for ros_name, own in named.items():
            if own not in joints:
                problem = f"{own!r}, called {ros_name!r}, is not among {', '.join(joints)}"
                raise ConfigurationError(where="joints", problem=problem)
        renamed = {own: ros_name for ros_name, own in named.items()}
        self.ros_names: Final = [renamed.get(own, own.rpartition(".")[2] if short else own) for own in joints]
        """In the order of the TRADE names."""
        if len(set(self.ros_names)) < len(joints):
            problem = f'two of {", ".join(joints)} would have one name. Set names = "full", or name them in joints'
            raise ConfigurationError(where="joints", problem=problem)
        self.trade_names: Final = dict(zip(self.ros_names, joints, strict=True))
