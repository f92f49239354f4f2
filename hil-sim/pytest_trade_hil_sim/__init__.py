"""A pytest plug-in with the fixture `simulated_robot`. It imports drivers and simulators only for tests that use it.

It is a package beside ``trade_hil_sim``, as a module inside of that one would import it in every pytest run.
"""

from collections.abc import Generator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pytest_trade_hil_sim.robots import SimulatedRobot, StartRobot
    from trade.testing import MemorySystem

__all__ = ["simulated_robot"]


@pytest.fixture
def simulated_robot(
    request: pytest.FixtureRequest, trade_system: "MemorySystem", tmp_path: Path
) -> "Generator[StartRobot, None, None]":
    """Starts the robot of a robot file on simulated devices: ``simulated_robot("head.toml")``.

    In a test that is marked ``virtual_time``, the robot is on virtual time.

    The path is relative to the folder of the test, or to pytest's root. Returns a
    `pytest_trade_hil_sim.robots.SimulatedRobot`, registered in `trade_system`. It ends with the test.

    Raises:
        ConfigurationError: there is no such file, or it is wrong.
        SimulationError: the devices cannot be simulated.
    """
    from pytest_trade_hil_sim import robots  # noqa: PLC0415 - see above

    with ExitStack() as undo:

        def start(robot_file: str | Path, *, rate_hz: float | None = None) -> "SimulatedRobot":
            file = robots.find_file(robot_file, [request.path.parent, request.config.rootpath])
            return undo.enter_context(robots.simulated_robot(file, trade_system, rate_hz=rate_hz, log_folder=tmp_path))

        yield start
