"""A 2F-85 as a Gripper. It checks arguments, queues a job for the bus thread, and waits for it."""

from trade import Resource
from trade.errors import DeviceSilent
from trade_drivers._validation import finite, within
from trade_drivers.bus._gate import admitted, at_once, span
from trade_drivers.bus._thread import BusThread
from trade_drivers.interfaces._motion import Gripper, GripperLimits, GripperState
from trade_drivers.vendors.robotiq import _table as table
from trade_drivers.vendors.robotiq._cycle import Exchange
from trade_drivers.vendors.robotiq._gripper_state import GripperDevice
from trade_drivers.vendors.robotiq._jobs import Activate, ClearFault, GripperCommand, Move


class RobotiqGripper(Gripper):
    """One gripper of a bus."""

    def __init__(self, thread: BusThread[Exchange], hand: GripperDevice) -> None:
        self._thread = thread
        self._exchange = thread.exchange
        self._hand = hand
        self._name = hand.name

    @property
    def resources(self) -> tuple[Resource, ...]:
        return (self._hand.resource,)

    def state(self) -> GripperState:
        exchange = self._exchange
        try:
            return self._hand.state(exchange.clock(), exchange.stale_after_ns)
        except DeviceSilent as silent:
            raise exchange.absence(self._hand, silent) from None

    def limits(self) -> GripperLimits:
        gripper, model = self._hand.gripper, self._hand.model
        return GripperLimits(
            name=self._name,
            min_width_m=gripper.min_width_m,
            max_width_m=gripper.max_width_m,
            min_speed_m_s=model.speeds_m_s[0],
            max_speed_m_s=gripper.max_speed_m_s,
            min_force_n=model.forces_n[0],
            max_force_n=gripper.max_force_n,
        )

    def activate(self) -> GripperState:
        with admitted(f"{self._name}.activate", self.resources, span(self._exchange.clock)) as terms:
            self._finish(Activate(self._exchange, [self._hand], terms))
        return self.state()

    def move_to(self, width_m: float, speed_m_s: float | None = None, force_n: float | None = None) -> GripperState:
        return self._move("move_to", width_m, speed_m_s, force_n)

    def open(self, speed_m_s: float | None = None) -> GripperState:
        return self._move("open", self._hand.gripper.max_width_m, speed_m_s, None)

    def close(self, speed_m_s: float | None = None, force_n: float | None = None) -> GripperState:
        return self._move("close", self._hand.gripper.min_width_m, speed_m_s, force_n)

    def stop(self) -> None:
        self._exchange.stop([self._hand]).wait(self._thread.alive)

    def clear_fault(self) -> None:
        with admitted(f"{self._name}.clear_fault", self.resources, at_once(self._exchange.clock)) as terms:
            self._finish(ClearFault(self._exchange, [self._hand], terms))

    def _move(self, name: str, width_m: float, speed_m_s: float | None, force_n: float | None) -> GripperState:
        service, limits, model = f"{self._name}.{name}", self.limits(), self._hand.model
        width = finite(width_m, service, "width_m")
        within(width, limits.min_width_m, limits.max_width_m, f"{self._name} width", "m")
        speed = limits.max_speed_m_s if speed_m_s is None else finite(speed_m_s, service, "speed_m_s")
        within(speed, limits.min_speed_m_s, limits.max_speed_m_s, f"{self._name} speed", "m/s")
        force = limits.max_force_n if force_n is None else finite(force_n, service, "force_n")
        within(force, limits.min_force_n, limits.max_force_n, f"{self._name} force", "N")
        registers = table.command(model.counts(width), model.speed_counts(speed), model.force_counts(force))
        with admitted(service, self.resources, span(self._exchange.clock)) as terms:
            self._finish(Move(self._exchange, [self._hand], registers, terms))
        return self.state()

    def _finish(self, job: GripperCommand) -> None:
        self._exchange.submit(job)
        job.wait(self._thread.alive)
