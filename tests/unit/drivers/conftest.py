"""A simulated head on a pty in this process, the driver attached to it, and the simulator's log as the judge."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.simulated_robots import HEAD, patient
from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.drivers.gate import Gate
from trade._context.call_context import CallContext, running
from trade.errors import DeviceSilent
from trade_drivers import AttachedRobot, Robot, attach, parse
from trade_hil_sim import DynamixelBus, Entry, Servo, events, motion_writes, writes

GOAL, TORQUE, WATCHDOG = 116, 64, 98


def sleep_past(moment_ns: int) -> None:
    """Let a moment of the monotonic clock pass."""
    while time.monotonic_ns() <= moment_ns:
        threading.Event().wait(0.005)


@contextmanager
def call(deadline_s: float) -> Iterator[int]:
    """What a provider sees while it serves a remote call: when that expires."""
    expires_ns = time.monotonic_ns() + int(deadline_s * 1e9)
    token = running.set(CallContext(id=1, service="test", caller="test", session="test", expires_ns=expires_ns))
    try:
        yield expires_ns
    finally:
        running.reset(token)


class Outcome:
    """A call running in a thread of its own."""

    def __init__(self, act: Callable[[], Any], deadline_s: float | None = None) -> None:
        self.result: Any = None
        self.error: BaseException | None = None
        self._act, self._deadline_s = act, deadline_s
        self._thread = threading.Thread(target=self._run, name="caller")
        self._thread.start()

    def _run(self) -> None:
        try:
            if self._deadline_s is None:
                self.result = self._act()
            else:
                with call(self._deadline_s):
                    self.result = self._act()
        except BaseException as error:  # noqa: BLE001 - raised in the thread that waits
            self.error = error

    def wait(self) -> "Outcome":
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive(), "the call has not ended"
        return self


class Rig:
    """A simulated bus and the driver attached to it."""

    def __init__(self, tmp_path: Path, undo: ExitStack) -> None:
        self._tmp_path, self._undo = tmp_path, undo
        self.robot: Robot = patient(parse(HEAD, "head.toml"))
        self.announced: list[object] = []

    def configure(self, *changes: tuple[str, str]) -> None:
        """Change the robot file's text."""
        text = HEAD
        for before, after in changes:
            assert before in text, before
            text = text.replace(before, after)
        self.robot = patient(parse(text, "head.toml"))

    def plug(
        self, *servos: Servo, prepare: Callable[[DynamixelBus], None] = lambda _: None, paced: bool = False
    ) -> DynamixelBus:
        """Simulate the bus of the robot file, or these servos; paced, the bytes take the time they take."""
        port = self._tmp_path / "neck"
        if servos:
            self.sim = DynamixelBus(servos, port, name="neck", paced=paced)
        else:
            bus = self.robot.buses[0]
            self.sim = DynamixelBus.from_robot(bus, self.robot.joints_on(bus.name), port, paced=paced)
        prepare(self.sim)
        return self._undo.enter_context(self.sim)

    def attach(self, **options: Any) -> AttachedRobot:
        """Attach the driver; it is closed with the test, whatever that says."""
        options.setdefault("ports", {"neck": str(self.sim.port)})
        options.setdefault("register", lambda _, groups: self.announced.append(groups))
        options.setdefault("deregister", lambda _: None)
        robot = attach(self.robot, **options)
        self._undo.callback(_close, robot)
        return robot

    @property
    def log(self) -> list[Entry]:
        return list(self.sim.log.entries)

    def goals(self, device_id: int | None = None, since: float = 0.0) -> list[Entry]:
        """Writes that touch a goal position."""
        return writes(self.log, device_id=device_id, register="goal_position", since=since)

    def moves(self, device_id: int | None = None, since: float = 0.0) -> list[Entry]:
        """Writes that could set something moving."""
        return motion_writes(self.log, device_id=device_id, since=since)

    def events(self, name: str, device_id: int | None = None, since: float = 0.0) -> list[Entry]:
        return events(self.log, name, device_id=device_id, since=since)

    def wait_for(self, name: str, device_id: int | None = None, since: float = 0.0) -> Entry:
        """The first such event from then on."""
        wait_until(lambda: self.events(name, device_id, since), f"{name} of {device_id}")
        return self.events(name, device_id, since)[0]

    def truth(self, device_id: int) -> Any:
        return next(device for device in self.sim.state().devices if device.device_id == device_id)


def _close(robot: AttachedRobot) -> None:
    try:
        robot.close()
    except Exception as error:  # noqa: BLE001 - what closing says is tested where it matters
        print(f"closing: {error}")


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.release()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with ExitStack() as undo:
        yield Rig(tmp_path, undo)


@pytest.fixture
def head(rig: Rig) -> Rig:
    """A plugged-in head."""
    rig.plug()
    return rig


def goal_counts(entry: Entry) -> int:
    """The goal position that a write carries: always its last four bytes here."""
    return int.from_bytes(entry.data[-4:], "little", signed=True)


def written_now() -> float:
    """A mark in the log's time."""
    return time.monotonic()


def is_silent(robot: AttachedRobot, joint: str) -> bool:
    try:
        robot.motor(joint).state()
    except DeviceSilent:
        return True
    return False
