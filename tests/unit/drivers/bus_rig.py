"""A simulated bus in this process, the driver attached to it, and the simulator's log as the judge: for all vendors."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

from tests.support.fake_container import fake_container
from tests.support.simulated_robots import patient
from tests.support.waiting import wait_until
from trade_drivers import AttachedRobot, Robot, attach, parse
from trade_hil_sim import LogEntry, events, motion_writes, writes


class BusRig:
    """A simulated bus and the driver attached to it."""

    original: ClassVar[str]
    """The robot file."""
    file: ClassVar[str]
    sim: Any

    def __init__(self, tmp_path: Path, undo: ExitStack) -> None:
        self._tmp_path, self._undo = tmp_path, undo
        self.announced: list[object] = []
        self.configure()

    def configure(self, *changes: tuple[str, str]) -> None:
        """Change the robot file's text."""
        text = self.original
        for before, after in changes:
            assert before in text, before
            text = text.replace(before, after)
        self.robot = self.read(text)

    def read(self, text: str) -> Robot:
        return patient(parse(text, self.file))

    def open(self, sim: Any, prepare: Callable[[Any], None]) -> Any:
        """Start a simulator once it is prepared."""
        self.sim = sim
        prepare(sim)
        return self._undo.enter_context(sim)

    @property
    def ports(self) -> dict[str, str]:
        return {self.robot.buses[0].name: str(self.sim.port)}

    def attach(self, **options: Any) -> AttachedRobot:
        """Attach the driver; it is closed with the test, whatever that says."""
        ports = options.pop("ports", None)
        options.setdefault("register", lambda _, groups: self.announced.append(groups))
        robot = attach(self.robot, fake_container(**options), ports=self.ports if ports is None else ports)
        self._undo.callback(_close, robot)
        return robot

    @property
    def log(self) -> list[LogEntry]:
        return list(self.sim.log.entries)

    def events(self, name: str, device_id: int | None = None, since: float = 0.0) -> list[LogEntry]:
        return events(self.log, name, device_id=device_id, since=since)

    def wait_for(self, name: str, device_id: int | None = None, since: float = 0.0) -> LogEntry:
        """The first such event from then on."""
        wait_until(lambda: self.events(name, device_id, since), f"{name} of {device_id}")
        return self.events(name, device_id, since)[0]

    def truth(self, device_id: int = 1) -> Any:
        return next(device for device in self.sim.state().devices if device.device_id == device_id)


class ServoRig(BusRig):
    """Servos on a pty."""

    sim_class: ClassVar[Any]

    def plug(self, *servos: Any, prepare: Callable[[Any], None] = lambda _: None, paced: bool = False) -> Any:
        """Simulate the bus of the robot file, or these servos; paced, the bytes take the time they take."""
        bus = self.robot.buses[0]
        port = self._tmp_path / bus.name
        if servos:
            return self.open(self.sim_class(servos, port, name=bus.name, paced=paced), prepare)
        return self.open(self.sim_class.from_robot(bus, self.robot.joints_on(bus.name), port, paced=paced), prepare)

    def goals(self, device_id: int | None = None, since: float = 0.0) -> list[LogEntry]:
        """Writes that touch a goal position."""
        return writes(self.log, device_id=device_id, register="goal_position", since=since)

    def moves(self, device_id: int | None = None, since: float = 0.0) -> list[LogEntry]:
        """Writes that could set something moving."""
        return motion_writes(self.log, device_id=device_id, since=since)


def _close(robot: AttachedRobot) -> None:
    try:
        robot.close()
    except Exception as error:  # noqa: BLE001 - what closing says is tested where it matters
        print(f"closing: {error}")
