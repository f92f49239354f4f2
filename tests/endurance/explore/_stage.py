"""What takes part in a story, what its clients do, and what is noted down of it."""

import random
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from tests.endurance.explore._gateway import Gateway
from tests.endurance.explore._judge import violations
from tests.endurance.explore._records import Drawn, Held, Moved, Stopped
from tests.endurance.explore._robots import KINDS, RobotKind
from trade import Container, errors, where
from trade.testing import MemorySystem, VirtualTime, memory_system
from trade_drivers import AttachedRobot, attach
from trade_hil_sim import Heal, LogEntry

CLIENTS: Final = ("planner", "worker")
_TICK_S: Final = 0.01
_LEFT_S: Final = 4.0
"""By then, the locks of clients that have ended are over, with their leases and the stops of their motion, and devices
that answer again have been tried, checked and accepted."""
_ENDING_S: Final = 3.0
"""How long what a failed call leaves may move: the lease of a client that died, then the way to rest (S05)."""
_DRIVERS_END_S: Final = 1.0
"""The same where its driver ends it, or has lost the device: a cycle or the device's own watchdog (S06, S08), then the
way to rest."""
_ENDED_BY_DRIVERS: Final = frozenset({"DeviceFault", "DeviceSilent", "MotionStopped", "Stopped"})
_BRAKING_S: Final = 0.35
"""From the end of a set-point to rest: cycles, and the slowest ramp of these robots (S04)."""
_REACH_RAD: Final = 0.6


@dataclass(frozen=True)
class Cast:
    """Who takes part in a story."""

    robots: tuple[RobotKind, ...]
    gateway: bool
    """Whether the planner is a client of another system, behind a gateway."""
    operator_beyond: bool
    """Whether the operator is one, too."""

    @classmethod
    def drawn(cls, drawn: random.Random) -> "Cast":
        robots = tuple(KINDS[group] for group in sorted(drawn.sample([*KINDS], 2)))
        gateway = drawn.random() < 0.5
        return cls(robots, gateway, gateway and drawn.random() < 0.5)

    def __str__(self) -> str:
        groups = " and ".join(one.group for one in self.robots)
        beyond = "planner and operator" if self.operator_beyond else "planner"
        return f"{groups}{f', {beyond} behind a gateway' if self.gateway else ''}"


@dataclass
class Outcome:
    """How a story went."""

    seed: int
    cast: Cast
    troubles: list[Drawn]
    calls: int = 0
    bytes: int = 0
    elapsed_s: float = 0.0
    switches: int = 0
    violations: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        sizes = f"{self.calls} calls, {self.bytes} log entries, {self.elapsed_s:.6f} s, {self.switches} switches"
        return f"seed {self.seed}: {self.cast}: {sizes}; {', '.join(map(str, self.troubles))}"


class Stage:
    """What takes part in a story, and what is noted down of it."""

    def __init__(self, clock: VirtualTime, outcome: Outcome, drawn: random.Random) -> None:
        self.clock = clock
        self.outcome = outcome
        self.drawn = drawn
        self.cast = outcome.cast
        self.over = threading.Event()
        """The clients end."""
        self._closing = threading.Event()
        self.held: list[Held] = []
        self.moved: list[Moved] = []
        self.stopped: list[Stopped] = []
        self.disturbed: list[float] = []
        """When something was done that may end a lock before its client knows."""
        self.past: set[str] = set()
        """The troubles that have begun so far."""
        self.began = time.monotonic()
        self.system: MemorySystem
        self.gateway: Gateway | None = None
        self.buses: dict[str, Any] = {}
        self.attached: dict[str, AttachedRobot] = {}

    @contextmanager
    def up(self) -> Iterator[None]:
        with ExitStack() as undo:
            folder = Path(undo.enter_context(tempfile.TemporaryDirectory()))
            self.system = undo.enter_context(memory_system(seed=self.outcome.seed))
            for kind in self.cast.robots:
                self._attach(kind, folder, undo)
            self.system.settle()
            if self.cast.gateway:
                public = undo.enter_context(memory_system(seed=self.outcome.seed))
                self.gateway = Gateway(self.system, public)
                self.gateway.start()
                undo.callback(self.gateway.close)
            for name in (*CLIENTS, "operator", "judge"):
                self.client(name)
            ticks = threading.Thread(target=self._tick, name="network")
            ticks.start()
            undo.callback(ticks.join)
            undo.callback(self._closing.set)
            undo.callback(self.over.set)
            yield

    def _attach(self, kind: RobotKind, folder: Path, undo: ExitStack) -> None:
        robot = kind.robot
        [bus] = robot.buses
        made = kind.simulator.from_robot(bus, robot.joints_on(bus.name), folder / bus.name, paced=not kind.can)
        self.buses[kind.group] = undo.enter_context(made)
        self.attach(kind)
        undo.callback(self.detach, kind)

    def attach(self, kind: RobotKind) -> None:
        """Attach the driver."""
        home, bus = self.system.container(kind.home), kind.robot.buses[0].name
        self.attached[kind.group] = attach(kind.robot, home, ports={bus: str(self.buses[kind.group].port)})

    def detach(self, kind: RobotKind) -> None:
        """Close the driver, if there is one."""
        if (attached := self.attached.pop(kind.group, None)) is not None:
            with suppress(errors.DeviceError):  # one that a trouble has left faulty
                attached.close()

    def _tick(self) -> None:
        systems = [self.system] if self.gateway is None else [self.system, self.gateway.clients]
        while not self._closing.wait(_TICK_S):
            for system in systems:
                system.clock.advance(_TICK_S)

    @property
    def beyond(self) -> Sequence[str]:
        """The clients behind the gateway."""
        if self.gateway is None:
            return ()
        return ("planner", "operator") if self.cast.operator_beyond else ("planner",)

    def client(self, name: str) -> Container:
        """The container of a client, started again if it was killed."""
        if self.gateway is not None and name in self.beyond:
            return self.gateway.client(name)
        return self.system.container(name)

    def system_of(self, name: str) -> MemorySystem:
        """Where a client is."""
        return self.gateway.clients if self.gateway is not None and name in self.beyond else self.system

    @property
    def operator(self) -> Container:
        return self.client("operator")

    def disturb(self) -> float:
        """Something begins that may end a lock before its client knows; when."""
        self.disturbed.append(time.monotonic())
        return self.disturbed[-1]

    # --- what clients do

    def plan(self, name: str) -> None:
        """Lock a group and move it, again and again."""
        drawn = random.Random(f"{self.outcome.seed} {name}")
        while not self.over.is_set():
            kind = drawn.choice(self.cast.robots)
            with suppress(errors.TradeError, TimeoutError):
                self._use(self.client(name), kind, drawn)
            if self.over.wait(drawn.uniform(0.0, 0.2)):
                return

    def _use(self, container: Container, kind: RobotKind, drawn: random.Random) -> None:
        act = drawn.choice((self._move, self._move, self._move, self._jog, self._tend))
        lock = container.lock(where(group=kind.group), wait_s=2.0)
        began = time.monotonic()
        lock.acquire()
        got = time.monotonic()
        try:
            with lock.use():
                act(container, kind, drawn)
        finally:
            ends = [time.monotonic(), *(at for at in self.disturbed if at >= began)]
            if min(ends) > got:
                self.held.append(Held(container.name, kind.group, got, min(ends)))
            with suppress(errors.TradeError):
                lock.release()

    def _move(self, container: Container, kind: RobotKind, drawn: random.Random) -> None:
        move = container.find(where(name="move_to", group=kind.group, kind="JointGroup"), wait_s=1.0)
        for _ in range(drawn.randrange(1, 4)):
            goal = [drawn.uniform(-_REACH_RAD, _REACH_RAD), drawn.uniform(-0.3, 0.3)]
            speed_rad_s = drawn.choice((2.0, 0.2))
            self._call(container, kind, move.with_(deadline_s=3.0), (goal, speed_rad_s), 0.0)

    def _jog(self, container: Container, kind: RobotKind, drawn: random.Random) -> None:
        """Give a joint speeds, each in time before the last one ends, and let the last one end by itself."""
        speed = container.find(where(name="set_velocity", group=kind.joints[0]), wait_s=1.0)
        velocity_rad_s, valid_s = drawn.choice((-0.4, 0.4)), drawn.choice((0.2, 1.0))
        for _ in range(drawn.randrange(1, 6)):
            self._call(container, kind, speed.with_(deadline_s=1.0), (velocity_rad_s, valid_s), valid_s + _BRAKING_S)
            if self.over.wait(0.1):
                return

    def _tend(self, container: Container, kind: RobotKind, drawn: random.Random) -> None:
        """Switch torque off, sometimes, and on again, as a person does who clears a fault: none of it moves a joint."""
        for name in ("relax", "enable") if drawn.random() < 0.3 else ("enable",):
            for joint in kind.joints:
                container.find(where(name=name, group=joint), wait_s=1.0).with_(deadline_s=3.0)()

    def _call(
        self, client: Container, kind: RobotKind, call: Callable[..., object], what: tuple[object, ...], lasts_s: float
    ) -> None:
        self.outcome.calls += 1
        since, how = time.monotonic(), ""
        try:
            call(*what)
        except BaseException as error:
            how = type(error).__name__
            lasts_s = _DRIVERS_END_S if how in _ENDED_BY_DRIVERS else _ENDING_S
            raise
        finally:
            self.moved.append(Moved(client.name, kind.group, since, time.monotonic(), how, lasts_s))

    # --- its end

    def judge(self) -> None:
        for bus in self.buses.values():
            bus.do(Heal())
        for kind in self.cast.robots:
            if kind.group not in self.attached:  # its device was silent each time that its driver was started
                self.attach(kind)
        self.clock.sleep(_LEFT_S)
        found = self.outcome.violations
        for system in ("judge", "planner"):
            locks = self.client(system).locks()
            found += [f"{one.holder.session} still has {one.resources}" for one in locks if one.token.number]
        ended = time.monotonic()
        logs: dict[str, Sequence[LogEntry]] = {group: list(bus.log.entries) for group, bus in self.buses.items()}
        self.outcome.bytes = sum(map(len, logs.values()))
        found += violations(logs, self.held, self.moved, self.stopped, ended)
        for group, bus in self.buses.items():
            if any(device.moving for device in bus.state().devices):
                found.append(f"{group} still moves at the end")
        for kind in self.cast.robots:
            found += self._unusable(kind)

    def _unusable(self, kind: RobotKind) -> list[str]:
        """Once everything is healed, an operator brings a robot back, and each client can move it again."""
        try:
            self._bring_back(kind)
            for name in ("judge", "planner"):
                client = self.client(name)
                with client.lock(where(group=kind.group), wait_s=5.0):
                    move = client.find(where(name="move_to", group=kind.group, kind="JointGroup"), wait_s=5.0)
                    move.with_(deadline_s=10.0)([0.1, 0.1], 1.0)
        except (errors.TradeError, TimeoutError) as error:
            return [f"{kind.group} cannot be used at the end: {type(error).__name__}: {error}"]
        return []

    def _bring_back(self, kind: RobotKind) -> None:
        for name in ("judge", "planner"):
            client = self.client(name)
            if opened := client.estops():
                client.estop_clear([one.id for one in opened])
        judge = self.client("judge")
        judge.resume(where(group=kind.group))
        for joint in kind.joints:
            judge.find(where(name="enable", group=joint), wait_s=5.0).with_(deadline_s=5.0)()
