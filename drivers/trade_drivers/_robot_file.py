"""Robot files with the errors of the middleware: a mistake in one is a ConfigurationError, as any other of a setup."""

from collections.abc import Generator, Iterable
from contextlib import contextmanager
from os import PathLike

import trade_robotfile
from trade.errors import ConfigurationError
from trade_robotfile import Robot, RobotFileError


@contextmanager
def robot_file_errors() -> Generator[None]:
    """Within it, a mistake in a robot file is raised as ConfigurationError."""
    try:
        yield
    except RobotFileError as bad:
        raise ConfigurationError(where=bad.where, problem=bad.problem) from None


def load(path: str | PathLike[str]) -> Robot:
    """Reads and checks a robot file.

    Raises:
        ConfigurationError: the file cannot be read or is invalid; the message names file, key and remedy.
    """
    with robot_file_errors():
        return trade_robotfile.load(path)


def parse(text: str, where: str) -> Robot:
    """Parses the text of a robot file.

    Args:
        text: the TOML.
        where: the file's name, for messages.

    Raises:
        ConfigurationError: the text is invalid; names file, key, value and the valid values.
    """
    with robot_file_errors():
        return trade_robotfile.parse(text, where)


def without(robot: Robot, names: Iterable[str]) -> tuple[Robot, list[str]]:
    """Returns the robot as if some of its buses, cameras or sensors were not in its file.

    With a bus, its devices are removed, and with a joint, all groups that contain it.

    Args:
        robot: the result of ``load``.
        names: of buses, cameras and sensors.

    Returns:
        The rest, and the names of all removed devices and groups.

    Raises:
        ConfigurationError: there is no such part, a remaining joint is coupled to a removed one, or nothing remains.
    """
    with robot_file_errors():
        return trade_robotfile.without(robot, names)
