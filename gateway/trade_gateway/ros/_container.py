"""A container of a configuration file that runs a ROS bridge."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from trade_gateway.config._kind import ContainerKind


class _RosContainer(ContainerKind):
    """Its value is the bridge file."""

    def extras(self, value: str) -> Iterable[tuple[str, str]]:  # noqa: ARG002
        return [("ros", "rosbags")]

    def words(self, name: str, value: str, place: Callable[[str], str]) -> list[str]:
        return ["ros", place(value), "--name", name]

    def check(self, value: str, beside: Callable[[str], Path]) -> None:
        from trade_gateway.ros._file import read_ros_file  # noqa: PLC0415 - loads what other containers do not need

        read_ros_file(beside(value))


KIND: Final = _RosContainer()
