"""A simulated arm, the driver attached to it, and the simulator's log as the judge."""

from collections.abc import Iterator
from contextlib import ExitStack, suppress
from typing import Any

import psutil
import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.attached_arm import ARM, AT_HOME, attached
from tests.unit.drivers.conftest import Outcome
from trade.errors import DeviceSilent
from trade_drivers import Arm, AttachedRobot
from trade_hil_sim import Arm as SimArm
from trade_hil_sim import LogEntry, UrBus, motion_writes

__all__ = ["FAR", "SLOW", "ArmRig", "answers", "arm_rig", "children", "free_rig"]

FAR = [3.0, *AT_HOME[1:]]
SLOW = 0.3


class ArmRig:
    """A simulated arm, and the driver attached to it."""

    def __init__(self, undo: ExitStack, arm: SimArm | None = None, text: str = ARM) -> None:
        self.undo, self._text = undo, text
        self.sim = undo.enter_context(UrBus(arm or SimArm(name="right", unlock_s=0.3), name="ur"))

    def attach(self, **options: Any) -> AttachedRobot:
        """Attach the driver; it is closed with the test, whatever that says."""
        self.robot = attached(self.undo, self.sim.port, self._text, **options)
        self.arm: Arm = self.robot.arm("right")
        return self.robot

    @property
    def log(self) -> list[LogEntry]:
        return self.sim.log.entries

    @property
    def truth(self) -> Any:
        return self.sim.state().arms[0]

    @property
    def moving(self) -> bool:
        return bool(self.truth.moving)

    @property
    def base_rad(self) -> float:
        return float(self.truth.positions_rad[0])

    def moves(self, since: float = 0.0) -> list[LogEntry]:
        return motion_writes(self.log, since=since)

    def set_off(self) -> Outcome:
        """Have it move far and slowly."""
        moving = Outcome(lambda: self.arm.move_joints(FAR, SLOW))
        wait_until(lambda: moving.error or self.base_rad > 0.05, "it is under way")
        assert moving.error is None
        return moving

    def comes_to_rest(self) -> None:
        wait_until(lambda: not self.moving, "it is at rest")
        assert self.base_rad < FAR[0] - 0.5


@pytest.fixture(name="rig")
def arm_rig() -> Iterator[ArmRig]:
    with ExitStack() as undo:
        rig = ArmRig(undo)
        rig.attach()
        yield rig


@pytest.fixture(name="free")
def free_rig() -> Iterator[ArmRig]:
    """A simulated arm without an attached driver."""
    with ExitStack() as undo:
        yield ArmRig(undo)


def answers(arm: Arm, since: float) -> bool:
    """It has been measured after that."""
    try:
        return arm.state().measured_at > since
    except DeviceSilent:
        return False


def children(role: str) -> list[int]:
    """The processes of that role that this one has started."""
    found: list[int] = []
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # it has just ended
            if f"trade_drivers.vendors.ur._{role}_child" in child.cmdline():
                found.append(child.pid)
    return found
