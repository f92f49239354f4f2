"""A story: two robots, two planners and an operator on virtual time, under troubles that a seed draws."""

import logging
import random
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from tests.endurance.explore._judge import violations
from tests.endurance.explore._records import Held, Moved, Stopped
from tests.support.simulated_robots import HEAD, TAIL
from trade import Container, errors, where
from trade.testing import MemorySystem, VirtualTime, memory_system, virtual_time
from trade_drivers import attach, parse
from trade_hil_sim import BadCrc, BrownOut, DynamixelBus, Entry, Late, Mute, Replug, Unplug
from trade_hil_sim.feetech import FeetechBus

GROUPS: Final = {"rosie.tail": (TAIL, FeetechBus), "rosie.head": (HEAD, DynamixelBus)}
_SWITCH: Final = 0.05
_STALL: Final = 0.0005
_TICK_S: Final = 0.005
_LASTS_S: Final = 6.0
_ENDS_S: Final = 30.0
"""Every call has ended by then: deadlines, leases and stops are shorter."""
_LEFT_S: Final = 4.0
"""After its client has ended, a lock ends within its lease and the stop of its motion."""
_REACH_RAD: Final = 0.6


@dataclass
class Outcome:
    """How a story went."""

    seed: int
    troubles: list[str]
    calls: int = 0
    bytes: int = 0
    elapsed_s: float = 0.0
    switches: int = 0
    violations: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        said = (
            f"seed {self.seed}: {self.calls} calls, {self.bytes} log entries, {self.elapsed_s:.6f} s, {self.switches} "
        )
        return f"{said}switches; {', '.join(self.troubles)}"


def play(seed: int, only: Sequence[int] | None = None) -> Outcome:
    """Play a story; ``only`` leaves out all of its troubles but those of these numbers."""
    drawn = random.Random(seed)
    troubles = [(number, *trouble) for number, trouble in enumerate(sorted(_drawn(drawn)))]
    troubles = [one for one in troubles if only is None or one[0] in only]
    outcome = Outcome(seed, [f"{number} {name} at {at_s:.2f} s" for number, at_s, name, _ in troubles])
    silent = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with virtual_time(seed, switch=_SWITCH, packages=["tests"]) as clock:
            _run(_Stage(clock, outcome, drawn), troubles)
            outcome.elapsed_s, outcome.switches = clock.elapsed_s, clock.switches
    except Exception as failed:  # noqa: BLE001 - a deadlock, or a thread that does not end, is a finding
        outcome.violations.append(f"{type(failed).__name__}: {failed}")
    finally:
        logging.disable(silent)
    return outcome


def _run(stage: "_Stage", troubles: Sequence[tuple[int, float, str, str]]) -> None:
    with stage.up():
        clients = [threading.Thread(target=stage.plan, args=(name,), name=name) for name in ("planner", "worker")]
        for thread in clients:
            thread.start()
        for _, at_s, name, group in troubles:
            stage.clock.sleep(max(0.0, stage.began + at_s - time.monotonic()))
            TROUBLES[name](stage, group)
        stage.clock.sleep(max(0.0, stage.began + _LASTS_S - time.monotonic()))
        stage.over.set()
        stage.clock.stall_threads(0.0)
        for thread in clients:
            thread.join(_ENDS_S)
        stage.outcome.violations += [f"a call of {one.name} does not end" for one in clients if one.is_alive()]
        stage.judge()


def _drawn(drawn: random.Random) -> Iterator[tuple[float, str, str]]:
    for _ in range(drawn.randrange(1, 6)):
        yield round(drawn.uniform(0.1, 0.7 * _LASTS_S), 3), drawn.choice([*TROUBLES]), drawn.choice([*GROUPS])


class _Stage:
    """What takes part in a story, and what is noted down of it."""

    def __init__(self, clock: VirtualTime, outcome: Outcome, drawn: random.Random) -> None:
        self.clock = clock
        self.outcome = outcome
        self.drawn = drawn
        self.over = threading.Event()
        self.held: list[Held] = []
        self.moved: list[Moved] = []
        self.stopped: list[Stopped] = []
        self.disturbed: list[float] = []
        """When something was done that may end a lock before its client knows."""
        self.began = time.monotonic()
        self.system: MemorySystem
        self.buses: dict[str, Any] = {}

    @contextmanager
    def up(self) -> Iterator[None]:
        with ExitStack() as undo:
            folder = Path(undo.enter_context(tempfile.TemporaryDirectory()))
            self.system = undo.enter_context(memory_system(seed=self.outcome.seed))
            for name in ("planner", "worker", "operator"):
                self.system.container(name)
            for group, (text, bus_class) in GROUPS.items():
                robot = parse(text, f"{group}.toml")
                [bus] = robot.buses
                made = bus_class.from_robot(bus, robot.joints_on(bus.name), folder / bus.name)
                self.buses[group] = undo.enter_context(made)
                home = self.system.container(group.replace(".", "-"))
                services = {"register": home.register, "deregister": home.deregister, "healthy": home.healthy}
                attached = attach(robot, ports={bus.name: str(made.port)}, **services)
                undo.callback(_close, attached.close)
            self.system.settle()
            ticks = threading.Thread(target=self._tick, name="network")
            ticks.start()
            undo.callback(ticks.join)
            undo.callback(self.over.set)
            yield

    def _tick(self) -> None:
        while not self.over.wait(_TICK_S):
            self.system.clock.advance(_TICK_S)

    @property
    def operator(self) -> Container:
        return self.system.container("operator")

    # --- what clients do

    def plan(self, name: str) -> None:
        """Lock a group and move it, again and again."""
        container = self.system.container(name)
        drawn = random.Random(f"{self.outcome.seed} {name}")
        while not self.over.is_set():
            group = drawn.choice([*GROUPS])
            with suppress(errors.TradeError, TimeoutError):
                self._move(container, group, drawn)
            if self.over.wait(drawn.uniform(0.0, 0.2)):
                return

    def _move(self, container: Container, group: str, drawn: random.Random) -> None:
        move = container.find(where(name="move_to", group=group, kind="JointGroup"), wait_s=1.0)
        lock = container.lock(where(group=group), wait_s=2.0)
        began = time.monotonic()
        lock.acquire()
        got = time.monotonic()
        try:
            with lock.use():
                for _ in range(drawn.randrange(1, 4)):
                    goal = [drawn.uniform(-_REACH_RAD, _REACH_RAD), drawn.uniform(-0.3, 0.3)]
                    self._call(container.name, group, lambda goal=goal: move.with_(deadline_s=3.0)(goal))
        finally:
            ends = [time.monotonic(), *(at for at in self.disturbed if at >= began)]
            if min(ends) > got:
                self.held.append(Held(container.name, group, got, min(ends)))
            with suppress(errors.TradeError):
                lock.release()

    def _call(self, client: str, group: str, call: Callable[[], object]) -> None:
        self.outcome.calls += 1
        since, how = time.monotonic(), ""
        try:
            call()
        except BaseException as error:
            how = type(error).__name__
            raise
        finally:
            self.moved.append(Moved(client, group, since, time.monotonic(), how))

    # --- its end

    def judge(self) -> None:
        self.clock.sleep(_LEFT_S)
        left = [f"{one.holder.session} still has {one.resources}" for one in self.operator.locks() if one.token.number]
        self.outcome.violations += left
        logs: dict[str, Sequence[Entry]] = {group: list(bus.log.entries) for group, bus in self.buses.items()}
        self.outcome.bytes = sum(map(len, logs.values()))
        self.outcome.violations += violations(GROUPS, logs, self.held, self.moved, self.stopped)
        for group, bus in self.buses.items():
            if any(device.moving for device in bus.state().devices):
                self.outcome.violations.append(f"{group} still moves at the end")


def _close(close: Callable[[], None]) -> None:
    with suppress(errors.DeviceError):  # one that a trouble has left faulty
        close()


# --- troubles


def _stop(stage: _Stage, group: str) -> None:
    asked = time.monotonic()
    stage.disturbed.append(asked)
    try:
        stage.operator.stop(group)
    except errors.TradeError:
        return  # it says what was not stopped
    since = time.monotonic()
    stage.clock.sleep(1.0)
    if any(one.how == "Stopped" and one.since < asked < one.until for one in stage.moved if one.group == group):
        stage.stopped.append(Stopped("stop", group, since, time.monotonic()))  # it ended a motion, so it holds
    with suppress(errors.TradeError):
        stage.operator.call(f"{group}.resume")


def _estop(stage: _Stage, _: str) -> None:
    stage.disturbed.append(time.monotonic())
    report = stage.operator.estop("drawn")
    since = time.monotonic()
    confirmed = not report.failed
    stage.clock.sleep(1.0)
    for group in GROUPS if confirmed else ():
        stage.stopped.append(Stopped("e-stop", group, since, time.monotonic()))
    stage.operator.estop_clear([report.id])


def _break(stage: _Stage, group: str) -> None:
    stage.disturbed.append(time.monotonic())
    with suppress(errors.TradeError):
        stage.operator.break_lock(where(group=group), reason="drawn")


def _kill(stage: _Stage, _: str) -> None:
    stage.disturbed.append(time.monotonic())
    stage.system.kill("worker")


def _partition(stage: _Stage, group: str) -> None:
    stage.disturbed.append(time.monotonic())
    client, robot = stage.drawn.choice(("planner", "worker")), group.replace(".", "-")
    stage.system.partition(client, robot)
    stage.clock.sleep(stage.drawn.uniform(0.1, 4.0))
    stage.system.heal(client, robot)


def _delay(stage: _Stage, _: str) -> None:
    stage.system.delay(0.002, jitter_s=stage.drawn.uniform(0.0, 0.1))


def _device(command: Callable[[random.Random], Any]) -> Callable[[_Stage, str], None]:
    def do(stage: _Stage, group: str) -> None:
        stage.buses[group].do(command(stage.drawn))

    return do


def _unplug(stage: _Stage, group: str) -> None:
    stage.buses[group].do(Unplug())
    stage.clock.sleep(stage.drawn.uniform(0.2, 3.0))
    stage.buses[group].do(Replug())


TROUBLES: Final[dict[str, Callable[[_Stage, str], None]]] = {
    "stop": _stop,
    "estop": _estop,
    "break lock": _break,
    "kill": _kill,
    "partition": _partition,
    "delay": _delay,
    "brown-out": _device(lambda _: BrownOut(ids=(1,))),
    "mute": _device(lambda drawn: Mute(ids=(1,), count=drawn.randrange(1, 9))),
    "late": _device(lambda drawn: Late(ids=(2,), count=drawn.randrange(1, 9), s=drawn.uniform(0.001, 0.1))),
    "bad checksum": _device(lambda drawn: BadCrc(ids=(1,), count=drawn.randrange(1, 9))),
    "unplug": _unplug,
    "clock step": lambda stage, _: stage.clock.step_wall_clock(stage.drawn.choice((-3600.0, -2.0, 2.0, 3600.0))),
    "stalls": lambda stage, _: stage.clock.stall_threads(_STALL),
}
