"""Runs the contracts on the devices of a robot file (hardware in the loop)."""

import argparse
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import pytest

import trade
from trade import where
from trade.errors import ConfigurationError, TradeError
from trade_drivers._attach import AttachedRobot, attach
from trade_drivers._robot_file import load
from trade_drivers.interfaces._arm import Arm
from trade_drivers.interfaces._motion import Gripper, JointGroup, Motor
from trade_drivers.interfaces._sensing import Camera, Sensor
from trade_drivers.testing._asking import REACH_RAD, SPEED_RAD_S
from trade_robotfile import Robot

_SUITE: Final = Path(__file__).with_name("_suite.py")
_KINDS: Final[Mapping[str, type[object]]] = {
    "motor": Motor,
    "group": JointGroup,
    "gripper": Gripper,
    "arm": Arm,
    "camera": Camera,
    "sensor": Sensor,
}
"""Fixtures of the contracts, and the devices that each of them covers."""
_REFUSED: Final = 2


def main(words: Sequence[str] | None = None) -> int:
    """Runs the contracts on a robot; returns pytest's exit code, or 2 if no test ran."""
    parser = argparse.ArgumentParser(
        prog="python -m trade_drivers.testing",
        description="Runs the contracts of all drivers on the devices of a robot file. Further arguments go to pytest.",
    )
    parser.add_argument("--hil", metavar="ROBOT.toml", required=True, help="the robot file")
    parser.add_argument("--port", metavar="BUS=PORT", action="append", default=[], help="instead of the file's port")
    parser.add_argument("--yes", action="store_true", help="do not ask for confirmation before devices move")
    options, rest = parser.parse_known_args(words)
    try:
        robot = load(options.hil)
        ports = dict(_port(word) for word in options.port)
        _refuse_if_in_use(robot)
        if not (options.yes or _agreed(robot)):
            return _REFUSED
        with attach(robot, announced=False, ports=ports) as attached:
            return int(pytest.main([*_WORDS, str(_SUITE), *rest], plugins=[_Devices(attached)]))
    except TradeError as problem:
        sys.stderr.write(f"{problem}\n")
        return _REFUSED
    finally:
        trade.close()


_WORDS: Final = ("-c", os.devnull, "--import-mode=importlib", "-p", "no:cacheprovider", "-v")
"""Options that make the suite independent of pytest settings in the current folder."""


def _port(word: str) -> tuple[str, str]:
    bus, equals, port = word.partition("=")
    if not equals:
        raise ConfigurationError(where="--port", problem=f"{word!r} is not BUS=PORT, such as neck=/dev/ttyUSB0")
    return bus, port


def _refuse_if_in_use(robot: Robot) -> None:
    """Refuses a robot with another driver, since not all buses can be locked.

    Raises:
        ConfigurationError: the robot's services are offered in this system; names the owners of their locks.
    """
    offered = trade.services(where(group=robot.name))
    if not offered:
        return
    places = sorted({f"{handle.container} on {handle.host}" for handle in offered})
    devices = {f"{robot.name}.{device.name}" for device in (*robot.joints, *robot.grippers, *robot.arms)}
    owners = sorted(
        {
            f"{lock.holder.identity}/{lock.holder.container} ({lock.holder.purpose or 'no purpose given'})"
            for lock in trade.locks()
            if devices & set(lock.resources)
        }
    )
    locked = f" and locked by {', '.join(owners)}" if owners else ""
    problem = f"its services are offered by {', '.join(places)}{locked}; end those programs first"
    raise ConfigurationError(where=robot.name, problem=problem)


def _agreed(robot: Robot) -> bool:
    if not (robot.joints or robot.grippers or robot.arms):
        return True  # cameras and sensors do not move
    if robot.joints:
        sys.stderr.write(
            f"{len(robot.joints)} joints of {robot.name} will be enabled, moved by up to {REACH_RAD} rad at "
            f"{SPEED_RAD_S} rad/s, and RELAXED again and again:\nwhat is not supported falls.\n"
        )
    if robot.grippers:
        sys.stderr.write(
            f"{len(robot.grippers)} grippers of {robot.name} will be activated, OPENED and CLOSED all the way again "
            "and again, as fast and as hard as the file allows:\nwhat they hold falls; nothing may be between their "
            "fingers.\n"
        )
    if robot.arms:
        sys.stderr.write(
            f"{len(robot.arms)} arms of {robot.name}, which must be powered, their brakes released, will be moved by\n"
            f"up to {REACH_RAD} rad at {SPEED_RAD_S} rad/s, along short lines, and be put into FREEDRIVE at times.\n"
        )
    sys.stderr.write("Type yes to continue: ")
    sys.stderr.flush()
    return sys.stdin.readline().strip() == "yes"


class _Devices:
    """A pytest plug-in that passes each device of the robot to the contracts, and leaves it relaxed."""

    def __init__(self, attached: AttachedRobot) -> None:
        self._providers: Mapping[str, object] = attached.providers

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        for fixture, kind in _KINDS.items():
            if fixture in metafunc.fixturenames:
                names = [name for name, provider in self._providers.items() if isinstance(provider, kind)]
                metafunc.parametrize(fixture, names, indirect=True)

    @pytest.fixture
    def motor(self, request: pytest.FixtureRequest) -> Iterator[object]:
        yield from self._device(request.param)

    @pytest.fixture
    def group(self, request: pytest.FixtureRequest) -> Iterator[object]:
        yield from self._device(request.param)

    @pytest.fixture
    def gripper(self, request: pytest.FixtureRequest) -> Iterator[object]:
        gripper = self._providers[request.param]
        assert isinstance(gripper, Gripper)  # noqa: S101 - pytest_generate_tests gave no other name
        gripper.activate()
        gripper.open()
        yield gripper
        gripper.stop()

    @pytest.fixture
    def arm(self, request: pytest.FixtureRequest) -> Iterator[object]:
        arm = self._providers[request.param]
        assert isinstance(arm, Arm)  # noqa: S101 - pytest_generate_tests gave no other name
        yield arm
        arm.stop()

    @pytest.fixture
    def camera(self, request: pytest.FixtureRequest) -> object:
        return self._providers[request.param]

    @pytest.fixture
    def sensor(self, request: pytest.FixtureRequest) -> object:
        return self._providers[request.param]

    def _device(self, name: str) -> Iterator[object]:
        device = self._providers[name]
        assert isinstance(device, Motor | JointGroup)  # noqa: S101 - pytest_generate_tests gave no other name
        device.relax()
        yield device
        device.stop()
        device.relax()
