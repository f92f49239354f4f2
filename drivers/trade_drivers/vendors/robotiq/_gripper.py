"""The state of one gripper on the bus thread: its measurement, its faults and its motion."""

import time
from typing import Final, Literal

from trade import Resource
from trade.errors import DeviceFault
from trade_drivers.bus._cycle import BusDevice
from trade_drivers.bus._jobs import AwaitedJob
from trade_drivers.interfaces._motion import GripperState
from trade_drivers.vendors.robotiq import _table as table
from trade_drivers.vendors.robotiq._table import Contact, Status
from trade_robotfile import Gripper

_HELD: Final[dict[int, Literal["outside", "inside"]]] = {Contact.CLOSING: "outside", Contact.OPENING: "inside"}
_HELD_COUNTS: Final = 1
_REMEDY: Final = "remove the cause, then call activate(): it moves the fingers all the way, and what they hold falls"
_NOT_ACTIVATED: Final = "it is not activated"


class GripperDevice(BusDevice[Status]):
    """The state of one gripper."""

    def __init__(self, name: str, bus: str, gripper: Gripper) -> None:
        super().__init__(name, bus, Resource(name))
        self.gripper = gripper
        self.id = gripper.id
        self.model = table.BY_MODEL_NAME[gripper.model]
        self.force_counts = 0
        """The last commanded force."""
        self.fault = ""
        """Why it refuses to move, from the gripper or from this driver; latched until a client clears it."""
        self.motion: GripperMotion | None = None
        self._holding: Literal["", "outside", "inside"] = ""
        self._held_at = 0
        self._speed_m_s = 0.0

    def take(self, registers: list[int], at_ns: int) -> Status:
        """Stores a measurement that was requested at this time."""
        before, now = self.sample, Status.decode(registers, at_ns)
        unmoved = before is not None and before.position == now.position
        self.still = self.still + 1 if unmoved and not now.under_way else 0
        if before is not None and at_ns > before.at_ns:
            counts_s = (now.position - before.position) / ((at_ns - before.at_ns) / 1e9)
            self._speed_m_s = -counts_s * self.model.m_per_count
        self._note_contact(now)
        self.sample = now
        self.fault = table.fault_text(now.fault) or self.fault
        self.misses = 0
        return now

    def _note_contact(self, now: Status) -> None:
        if now.going and now.activated:
            self._holding = _HELD.get(now.contact, "")
            self._held_at = now.position
        elif not now.activated or abs(now.position - self._held_at) > _HELD_COUNTS:
            self._holding = ""

    def at_rest(self, now_ns: int, stale_after_ns: int) -> bool:
        """Returns whether it is measured at rest without a commanded motion; it may be pressing on an object."""
        known = self.sample is not None and not self.doubted and not self.silent
        return known and self.motion is None and self.still > 0 and self.age_ns(now_ns) <= stale_after_ns

    def standing(self, now_ns: int, stale_after_ns: int) -> bool:
        """Returns whether it is at rest and has no goal."""
        commanded = self.sample is not None and self.sample.going and self.sample.activated
        return self.at_rest(now_ns, stale_after_ns) and not commanded

    def halt_registers(self) -> tuple[int, int, int]:
        """Returns the command that stops it.

        Without activation, a gripper stops in each state. The command keeps the activation only if it is certain, as
        writing it to a gripper that has lost it would move the fingers.
        """
        sample = self.sample
        if sample is None or self.doubted or self.silent or not sample.activated:
            return table.RESET
        return table.command(sample.echo, 0, self.force_counts, go=False)

    def tell_moving(self) -> None:
        """Sets ``resource.moving`` from the last measurement or command."""
        under_way = self.motion is not None or self.halting_since_ns > 0
        if under_way or not (self.silent or self.doubted):
            self.resource.moving = under_way or self.still == 0

    def check_usable(self, now_ns: int, stale_after_ns: int) -> Status:
        """Returns the newest measurement if the fingers may be commanded.

        Raises:
            DeviceSilent: the gripper does not answer.
            DeviceFault: the gripper has a fault, or is not activated.
        """
        sample = self.fresh(now_ns, stale_after_ns)
        if self.fault:
            raise self.fault_error()
        if not sample.activated:
            raise self.inactive()
        return sample

    def inactive(self, fault: str = _NOT_ACTIVATED) -> DeviceFault:
        """Returns the error for a gripper without activation."""
        remedy = "call activate(): it moves the fingers all the way, and what they hold falls"
        return DeviceFault(device=self.name, bus=self.bus, fault=fault, remedy=remedy)

    def fault_error(self, fault: str = "") -> DeviceFault:
        return DeviceFault(device=self.name, bus=self.bus, fault=fault or self.fault, remedy=_REMEDY)

    def state(self, now_ns: int, stale_after_ns: int) -> GripperState:
        """Returns the newest measurement.

        Raises:
            DeviceSilent: the measurement is too old.
        """
        sample = self.fresh(now_ns, stale_after_ns)
        age_s = (now_ns - sample.at_ns) / 1e9
        low, high = self.model.forces_n
        return GripperState(
            name=self.name,
            width_m=self.model.width_m(sample.position),
            speed_m_s=self._speed_m_s,
            force_n=low + (high - low) * self.force_counts / 255,
            current_a=sample.current * table.AMPERE_PER_COUNT,
            holding=self._holding,
            activated=sample.activated,
            moving=self.motion is not None or self.still == 0,
            fault=self.fault,
            measured_at=time.monotonic() - age_s,
            age_s=age_s,
        )


class GripperMotion(AwaitedJob[GripperDevice]):
    """A motion of the fingers, as far as the gripper knows it."""

    def watch(self, now_ns: int) -> None:
        """Checks the newest measurement, and ends the motion if it is over or must not continue."""
        raise NotImplementedError
