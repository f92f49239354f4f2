"""A gripper in memory for tests: it moves instantly, and refuses the same commands as a real one."""

import time
from typing import Final, Literal

from trade import Resource
from trade_drivers._validation import finite, within
from trade_drivers.interfaces._motion import FingerSpeed, Force, Gripper, GripperLimits, GripperState, Width
from trade_drivers.testing._fake_device import FakeActuator

_WIDEST_M: Final = 0.085
_SPEEDS_M_S: Final = (0.02, 0.15)
_FORCES_N: Final = (20.0, 235.0)


class FakeGripper(FakeActuator[float], Gripper):
    """Fingers that reach each width instantly, or an object before it. For tests of behaviours, not of drivers.

    Its services, types, limits and refusals are those of a `Gripper`. As a real one, it moves only once activated.
    """

    def __init__(self, name: str, limits: GripperLimits | None = None) -> None:
        """An open gripper that is not activated.

        Args:
            name: its full name, such as ``rosie.left.hand``.
            limits: by default 0 to 85 mm, 0.02 to 0.15 m/s and 20 to 235 N.
        """
        super().__init__(name, [Resource(name)])
        self.object_width_m: float | None = None
        """Width of the object between the fingers; None: there is none."""
        self._limits = _limits(name) if limits is None else limits
        self._width = self._limits.max_width_m
        self._force = 0.0
        self._holding: Literal["", "outside"] = ""
        self._activated = False

    def state(self) -> GripperState:
        """Returns the state, which is at rest unless a test holds a motion up."""
        self._answer()
        return GripperState(
            name=self._name,
            width_m=self._width,
            speed_m_s=0.0,
            force_n=self._force,
            current_a=0.0,
            holding=self._holding,
            activated=self._activated,
            moving=self._moving,
            fault=self._fault,
            measured_at=time.monotonic(),
            age_s=0.0,
        )

    def limits(self) -> GripperLimits:
        """Returns the limits from the constructor."""
        return self._limits

    def activate(self) -> GripperState:
        """Clears a fault, and opens; does nothing to an activated gripper without a fault."""
        with self._command("activate"):
            if self._fault or not self._activated:
                self._fault, self._activated = "", True
                self._width, self._holding = self._limits.max_width_m, ""
        return self.state()

    def move_to(
        self, width_m: Width, speed_m_s: FingerSpeed | None = None, force_n: Force | None = None
    ) -> GripperState:
        """Sets the width, or stops at an object on the way."""
        return self._go("move_to", width_m, speed_m_s, force_n)

    def open(self, speed_m_s: FingerSpeed | None = None) -> GripperState:
        """Sets the maximum width."""
        return self._go("open", self._limits.max_width_m, speed_m_s, None)

    def close(self, speed_m_s: FingerSpeed | None = None, force_n: Force | None = None) -> GripperState:
        """Sets the minimum width, or stops at an object."""
        return self._go("close", self._limits.min_width_m, speed_m_s, force_n)

    def stop(self) -> None:
        """Records the stop; no motion takes time."""
        self._stop()

    def clear_fault(self) -> None:
        """Clears a fault; the gripper has to be activated again."""
        with self._command("clear_fault"):
            self._fault, self._activated = "", False

    def _work(self) -> None:
        super()._work()
        if not self._activated:
            raise self._refusal("it is not activated", "call activate()")

    def _go(self, service: str, width_m: float, speed_m_s: float | None, force_n: float | None) -> GripperState:
        limits = self._limits
        goal = finite(width_m, service, "width_m")
        within(goal, limits.min_width_m, limits.max_width_m, f"{self._name} width", "m")
        if speed_m_s is not None:
            speed = finite(speed_m_s, service, "speed_m_s")
            within(speed, limits.min_speed_m_s, limits.max_speed_m_s, f"{self._name} speed", "m/s")
        force = limits.max_force_n if force_n is None else finite(force_n, service, "force_n")
        within(force, limits.min_force_n, limits.max_force_n, f"{self._name} force", "N")
        with self._command(service, goal):
            found = self.object_width_m
            self._force = force
            if found is not None and goal < found <= self._width:
                self._width, self._holding = found, "outside"
            else:
                self._width, self._holding = goal, ""
        return self.state()


def _limits(name: str) -> GripperLimits:
    return GripperLimits(
        name=name,
        min_width_m=0.0,
        max_width_m=_WIDEST_M,
        min_speed_m_s=_SPEEDS_M_S[0],
        max_speed_m_s=_SPEEDS_M_S[1],
        min_force_n=_FORCES_N[0],
        max_force_n=_FORCES_N[1],
    )
