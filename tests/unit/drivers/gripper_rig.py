"""A simulated hand on a pty in this process, the driver attached to it, and the simulator's log as the judge."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from tests.support.simulated_robots import HAND, patient
from tests.support.waiting import wait_until
from trade.errors import DeviceError
from trade_drivers import AttachedRobot, Gripper, Robot, attach, parse
from trade_hil_sim import Entry, GripperTruth, RobotiqBus, events, motion_writes, writes


class HandRig:
    """A simulated bus and the driver attached to it."""

    def __init__(self, tmp_path: Path, undo: ExitStack) -> None:
        self._tmp_path, self._undo = tmp_path, undo
        self.robot: Robot = patient(parse(HAND, "hand.toml"))
        self.announced: list[object] = []

    def configure(self, *changes: tuple[str, str]) -> None:
        text = HAND
        for before, after in changes:
            assert before in text, before
            text = text.replace(before, after)
        self.robot = patient(parse(text, "hand.toml"))

    def plug(self, prepare: Callable[[RobotiqBus], None] = lambda _: None) -> RobotiqBus:
        """Simulate the bus of the robot file."""
        bus = self.robot.buses[0]
        self.sim = RobotiqBus.from_robot(bus, self.robot.grippers_on(bus.name), self._tmp_path / "hand", paced=False)
        prepare(self.sim)
        return self._undo.enter_context(self.sim)

    def attach(self, **options: Any) -> AttachedRobot:
        """Attach the driver; it is closed with the test, whatever that says."""
        options.setdefault("ports", {"hand": str(self.sim.port)})
        options.setdefault("register", lambda _, groups: self.announced.append(groups))
        options.setdefault("deregister", lambda _: None)
        robot = attach(self.robot, **options)
        self._undo.callback(_close, robot)
        return robot

    def gripper(self, **options: Any) -> Gripper:
        return self.attach(**options).gripper("left.hand")

    def active(self, **options: Any) -> Gripper:
        """Attached and activated."""
        made = self.gripper(**options)
        made.activate()
        return made

    @property
    def log(self) -> list[Entry]:
        return list(self.sim.log.entries)

    def moves(self, since: float = 0.0) -> list[Entry]:
        """Writes that could set the fingers moving; those that stop them are none."""
        return motion_writes(self.log, since=since)

    def writes(self, since: float = 0.0) -> list[Entry]:
        return writes(self.log, since=since)

    def wait_for(self, name: str, since: float = 0.0) -> Entry:
        """The first such event from then on."""
        wait_until(lambda: events(self.log, name, since=since), name)
        return events(self.log, name, since=since)[0]

    @property
    def truth(self) -> GripperTruth:
        return self.sim.state().grippers[0]

    def under_way(self) -> None:
        """Wait until the fingers have left their open end."""
        wait_until(lambda: self.truth.moving and self.truth.width_m < 0.083, "it is under way")


@contextmanager
def made_rig(tmp_path: Path) -> Iterator[HandRig]:
    with ExitStack() as undo:
        yield HandRig(tmp_path, undo)


def _close(robot: AttachedRobot) -> None:
    try:
        robot.close()
    except Exception as error:  # noqa: BLE001 - what closing says is tested where it matters
        print(f"closing: {error}")


def silent(gripper: Gripper) -> bool:
    """Whether it does not say how it is."""
    try:
        gripper.state()
    except DeviceError:
        return True
    return False
