"""Joints: what all vendors of servos, drives and motors have in common."""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, ClassVar

from tests.contract.rigs.base import DriverProcess, Request, SafetyRig
from tests.support.simulated_robots import at_rest
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome
from trade import Container
from trade.errors import DeviceFault, TradeError
from trade_drivers.bus._gate import Terms
from trade_drivers.joints._motion import Move
from trade_hil_sim import Absent, LogEntry, Mute, Place

__all__ = ["FIRST", "SECOND", "JointRig"]

FIRST, SECOND = 1, 2
_SLOWLY_RAD_S = 0.3
_UNDER_WAY = 0.05


class JointRig(SafetyRig):
    """Two joints in a group; the first is the one that rules move."""

    bus: ClassVar[str]
    joint: ClassVar[str]
    group: ClassVar[str]
    max_rad: ClassVar[float]
    too_slow_rad_s: ClassVar[float]
    within_rad: ClassVar[float] = 0.03
    """How near to its goal a move ends."""
    exactly_rad: ClassVar[float] = 2e-3
    """How near to the measured position the targets of an enabled joint are."""
    lost = (Mute(ids=(FIRST,), count=1),)
    absent = Absent(ids=(SECOND,))
    set_point = ("set_velocity", 0.3, 1.0)
    readying = harmless = ("enable",)

    @property
    def resource(self) -> str:  # type: ignore[override]
        return f"rosie.{self.joint}"

    @property
    def second(self) -> str:
        """The other joint of the group."""
        return str(self.bench.robot.joints[1].name)

    @property
    def far(self) -> Request:
        return ("move_to", 0.93 * self.max_rad)

    @property
    def slowly(self) -> Request:
        return (*self.far, 0.1)

    @property
    def drift(self) -> float:  # type: ignore[override]
        return 0.3 / self.far[1]

    others: ClassVar[Sequence[Request]] = ()
    """Services that other vendors do not have."""

    def requests(self, container: Container) -> Iterable[Callable[[], object]]:
        for request in (("move_to", 0.3), ("set_velocity", 0.3), ("enable",), ("relax",), *self.others):
            yield partial(self.asked, container, request)
        yield lambda: self.service(container, "servo", f"rosie.{self.group}")([0.3, 0.3])

    def moves_back(self, container: Container) -> bool:
        return abs(self.asked(container, ("move_to", 0.1)) - 0.1) < self.within_rad

    @property
    def text(self) -> str:
        return str(self.bench.text)

    def attach(self, **options: Any) -> None:
        self.plug()
        self.robot = self.bench.attach(**options)
        self.device = self.robot.motor(self.joint)

    def attach_to_ask(self) -> None:
        """Attach as a robot that keeps its joints' last known angles."""
        self.attach(state_dir=self.folder)

    def noticed(self) -> bool:
        """Whether the driver has noticed that the device lost its power."""
        try:
            return bool(self.device.state().fault)
        except DeviceFault:
            return True
        except TradeError:
            return False

    def ready(self) -> None:
        self.device.enable()

    def commands(self) -> Iterable[Callable[[], object]]:
        return (*self.queued_when_ready(), self.device.enable)

    def queued_when_ready(self) -> Iterable[Callable[[], object]]:
        return (self.move, lambda: self.device.set_velocity(0.5, 0.05), self.device.relax)

    def move(self) -> object:
        return self.device.move_to(0.5)

    def set_off(self, speed_rad_s: float = _SLOWLY_RAD_S) -> Outcome:
        moving = Outcome(lambda: self.device.move_to(0.93 * self.max_rad, speed_rad_s))
        wait_until(lambda: moving.error or self.travelled() > _UNDER_WAY, "it is under way")
        assert moving.error is None, moving.error
        return moving

    def under_way(self) -> None:
        wait_until(lambda: self.travelled() > _UNDER_WAY, "it is under way")

    def outside(self) -> Iterable[Callable[[], object]]:
        joint, group = self.device, self.robot.group(self.group)
        for value in (self.max_rad + 0.001, -self.max_rad - 0.001, 7.0, 1e300, math.nan, math.inf, -math.inf):
            yield lambda value=value: joint.move_to(value)
            yield lambda value=value: group.move_to([0.1, value])
        for speed in (2.51, 0.0, -1.0, math.nan, math.inf, self.too_slow_rad_s):
            yield lambda speed=speed: joint.move_to(0.1, speed)
            yield lambda speed=speed: group.move_to([0.1, 0.1], speed)

    def forged(self, goal_rad: float, permit: Any) -> Move:
        """A move at the bus thread that no service has checked."""
        exchange, axes = self.exchange, self.device._axes
        goals, expires_ns = [round(axes[0].scale.counts(goal_rad))], exchange.clock() + 10**10
        move = Move(exchange, axes, goals, [50], Terms("x", expires_ns, None, permit))
        exchange.submit(move)
        return move

    def sent_away(self, since: float, within_rad: float = 0.002) -> Sequence[object]:
        here = self.truth().position_rad
        return [target for target in self.targets_rad(since) if abs(target - here) > within_rad]

    def truth(self, device_id: int = FIRST) -> Any:
        return self.bench.truth(device_id)

    def place(self, position_rad: float) -> None:
        """Turn the first joint by hand, before or after the driver is attached."""
        self.plug()
        self.bench.sim.do(Place(ids=(FIRST,), counts=self.counts(position_rad)))

    def counts(self, position_rad: float) -> int:
        raise NotImplementedError

    @property
    def moving(self) -> bool:
        return bool(self.truth().moving)

    def at_rest(self) -> bool:
        return at_rest(self.truth())

    def travelled(self) -> float:
        return float(self.truth().position_rad) / (0.93 * self.max_rad)

    def events(self, name: str, since: float) -> Sequence[LogEntry]:
        return self.bench.events(name, FIRST, since)

    def driver_process(self) -> DriverProcess:
        self.plug()
        file = self.folder / "robot.toml"
        file.write_text(self.text, encoding="utf-8")
        made = DriverProcess("driver_process.py", str(file), str(self.bench.sim.port), self.bus, self.joint)
        self.undo.callback(made.close)
        assert made.line() == "attached"
        return made

    def stopped_by_itself(self, since: float) -> float:
        """Wait until the device has stopped without its driver; when."""
        return float(self.bench.wait_for("watchdog_expired", FIRST, since).t)

    @abstractmethod
    def targets_rad(self, since: float) -> Sequence[float]:
        """Where the first joint was sent."""

    def leaves(self, leave: str) -> None:
        raise NotImplementedError

    def disarmed(self) -> bool:
        """Whether the device no longer waits for its driver after a leave that holds."""
        return True

    def judge_stop(self, asked: float) -> None:
        """What the wire must show of a stop while the second joint is silent."""
