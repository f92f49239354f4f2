"""What all fake devices share: faults on demand, and a record of what was commanded."""

import math
import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Final, Generic, TypeVar

from trade import Permit, Resource, current_call, permit
from trade.errors import DeviceFault, DeviceSilent, MotionStopped, ToleranceExceeded
from trade_drivers.interfaces._motion import Lockable
from trade_drivers.motion._plan import Plan

_BUS: Final = "memory"
_SILENT_S: Final = 1.0
_LOOK_S: Final = 0.005
_SET_POINTS: Final = ("servo", "set_velocity")
"""Services that command a motion and do not wait for it."""

_Goal = TypeVar("_Goal", float, list[float])


class FakeDevice:
    """A device in memory. It has no thread and no port, and it is silent or faulty when a test says so."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._fault = ""
        self._is_silent = False

    @property
    def name(self) -> str:
        """Its name, as in its state and its errors; of one device on a robot, also its group: ``rosie.right``."""
        return self._name

    def fail(self, fault: str) -> None:
        """Reports a fault from now on: commands raise ``DeviceFault``, and nothing moves.

        It lasts until the program clears it with the service for that, such as ``enable()``, or the test recovers it.
        """
        self._fault = fault

    def go_silent(self) -> None:
        """Stops answering: every service that needs the device raises ``DeviceSilent`` until ``recover()``."""
        self._is_silent = True

    def recover(self) -> None:
        """Ends the fault and the silence."""
        self._fault, self._is_silent = "", False

    def _answer(self) -> None:
        """Raises DeviceSilent if the device is silent."""
        if self._is_silent:
            raise DeviceSilent(device=self._name, bus=_BUS, waited_s=_SILENT_S)

    def _work(self) -> None:
        """Raises DeviceFault if the device does not move or measure."""
        if self._fault:
            raise self._refusal(self._fault)

    def _refusal(self, fault: str, remedy: str = "remove the cause") -> DeviceFault:
        return DeviceFault(device=self._name, bus=_BUS, fault=fault, remedy=remedy)


class FakeActuator(FakeDevice, Lockable, Generic[_Goal]):
    """A device that moves instantly, unless a test holds it up. Locks, stops and e-stops apply to it."""

    def __init__(self, name: str, resources: Sequence[Resource]) -> None:
        super().__init__(name)
        self.commands: list[tuple[str, _Goal | None]] = []
        """Services that were carried out, oldest first, with the goal of each; None: it has no goal."""
        self.arrives = threading.Event()
        """While a test has it cleared, a motion lasts until it is set, stopped or cancelled, or until its deadline."""
        self.arrives.set()
        self._resources = tuple(resources)
        self._moving = False

    @property
    def went(self) -> list[_Goal]:
        """The goals of all commands, oldest first."""
        return [goal for _, goal in self.commands if goal is not None]

    @property
    def resources(self) -> tuple[Resource, ...]:
        """The resources of the device."""
        return self._resources

    @contextmanager
    def _command(self, service: str, goal: _Goal | None = None, *, moves: bool = False) -> Generator[None, None, None]:
        """Lets the block carry out a command that locks, stops and faults allow, and records it.

        Args:
            service: the name of the service.
            goal: where the device moves.
            moves: a fault refuses the command, as it does if there is a goal.
        """
        with permit(self._resources) as permitted:
            permitted.gate()
            self._answer()
            if moves or goal is not None:
                self._work()
            if goal is not None and service not in _SET_POINTS:
                self._travel(permitted)
            yield
            self.commands.append((service, goal))

    def _travel(self, permitted: Permit) -> None:
        """Waits until the motion arrives. Raises what ends it before."""
        self._show(moving=not self.arrives.is_set())
        try:
            while not self.arrives.wait(_LOOK_S):
                permitted.gate()
                call = current_call()
                if call is not None:
                    call.raise_if_cancelled()
                    if call.remaining_s == 0:
                        raise MotionStopped(device=self._name, reason="its call reached its deadline", late=True)
        finally:
            self._show(moving=False)

    def _show(self, *, moving: bool) -> None:
        self._moving = moving

    def _stop(self) -> None:
        """Records a stop, which nothing refuses. Raises DeviceSilent, as nothing confirms it then."""
        self.commands.append(("stop", None))
        self._answer()


def end_of(plan: Plan, angles: Sequence[float]) -> list[float]:
    """Returns the last angles of a plan.

    Raises:
        ToleranceExceeded: a joint is not where the plan begins.
    """
    for (limits, curve), angle in zip(plan.tracks, angles, strict=True):
        error_rad, allowed_rad = angle - curve.at(0.0)[0], plan.tolerances.start_rad
        if abs(error_rad) > allowed_rad:
            raise ToleranceExceeded(
                device=limits.name, bus=_BUS, what="start", error_rad=error_rad, tolerance_rad=allowed_rad
            )
    return [curve.at(math.inf)[0] for _, curve in plan.tracks]


def report_whole(plan: Plan) -> None:
    """Reports a plan as completed."""
    plan.course.ready(0)
    plan.course.report(math.ceil(plan.course.duration_s * 1e9))
