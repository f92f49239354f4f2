"""A simulated hand on a pty in this process, the driver attached to it, and the simulator's log as the judge."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.support.simulated_robots import HAND
from tests.support.waiting import wait_until
from tests.unit.drivers.bus_rig import BusRig
from trade.errors import DeviceError
from trade_drivers import Gripper
from trade_hil_sim import GripperTruth, LogEntry, RobotiqBus, events, motion_writes, writes


class HandRig(BusRig):
    """A gripper 2F-85."""

    original, file = HAND, "hand.toml"

    def plug(self, prepare: Callable[[RobotiqBus], None] = lambda _: None) -> RobotiqBus:
        """Simulate the bus of the robot file."""
        bus = self.robot.buses[0]
        grippers = self.robot.grippers_on(bus.name)
        return self.open(RobotiqBus.from_robot(bus, grippers, self._tmp_path / bus.name, paced=False), prepare)

    def gripper(self, **options: Any) -> Gripper:
        return self.attach(**options).gripper("left.hand")

    def active(self, **options: Any) -> Gripper:
        """Attached and activated."""
        made = self.gripper(**options)
        made.activate()
        return made

    def moves(self, since: float = 0.0) -> list[LogEntry]:
        """Writes that could set the fingers moving; those that stop them are none."""
        return motion_writes(self.log, since=since)

    def writes(self, since: float = 0.0) -> list[LogEntry]:
        return writes(self.log, since=since)

    def wait_for(self, name: str, since: float = 0.0) -> LogEntry:
        """The first such event from then on."""
        wait_until(lambda: events(self.log, name, since=since), name)
        return events(self.log, name, since=since)[0]

    @property
    def truth(self) -> GripperTruth:
        return self.sim.state().grippers[0]

    def under_way(self) -> None:
        """Wait until the fingers have left their open end."""
        wait_until(lambda: self.truth.moving and self.truth.width_m < 0.083, "it is under way")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[HandRig]:
    with ExitStack() as undo:
        yield HandRig(tmp_path, undo)


@pytest.fixture
def hand(rig: HandRig) -> HandRig:
    """A plugged-in hand."""
    rig.plug()
    return rig


def silent(gripper: Gripper) -> bool:
    """Whether it does not say how it is."""
    try:
        gripper.state()
    except DeviceError:
        return True
    return False
