"""One simulated 2F-85: registers, activation, fingers that move at constant speed, an object between them.

Time is an argument everywhere, in seconds on the caller's clock; everything happens in `advance`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import inf
from typing import Final

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.log._byte_log import LogEntry
from trade_hil_sim.mechanics._truth import GripperTruth
from trade_hil_sim.serial._device_bus import LineDevice

from . import _table as table

CYCLE_S: Final = 0.005
"""The motion control applies requests at its next cycle; until then the status is the previous one."""
ACTIVATION_COUNTS_S: Final = 320.0
"""How fast the fingers close and open while they find their stops."""
PATIENCE_S: Final = 1.0
"""Without a request for this long: fault 09, until the cycle after the next request."""
HOT_C: Final = 85
"""Fault 08 begins at this temperature: an assumption, as are the two below."""
COOL_C: Final = 80
"""Fault 08 ends below this temperature."""
LEAST_V: Final = 21.6
"""Fault 0A begins below this supply, 24 V less a tenth."""
_MOVING_CURRENT: Final = 12
_NEVER: Final = inf
_CLOSE_COUNTS: Final = 0.5


class Contact(IntEnum):
    """gOBJ: what the fingers have met."""

    MOVING = 0
    OPENING = 1
    CLOSING = 2
    ARRIVED = 3


@dataclass(frozen=True, slots=True)
class Object:
    """An object between the fingers, or around them."""

    width_m: float
    stiffness_n_m: float
    inside: bool
    """It is hollow, and the fingers meet it from inside, by opening."""


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Fingers that move at constant speed, or rest where a motion ends."""

    begins: float
    start: float
    goal: float
    speed: float

    @property
    def ends(self) -> float:
        return self.begins + abs(self.goal - self.start) / self.speed

    def at(self, t: float) -> float:
        left = min(abs(self.goal - self.start), max(0.0, t - self.begins) * self.speed)
        return self.start + left if self.goal > self.start else self.start - left


def _within(counts: int) -> int:
    """A request, as far as the stops let the fingers go."""
    return min(table.CLOSED_COUNTS, max(table.OPEN_COUNTS, counts))


class Gripper(LineDevice):
    """A gripper on the bus, powered up at `t` and not activated.

    Args:
        device_id: slave id.
        name: the gripper's name in the robot file, for the log.
        width_m: its opening.
        t: now.
        baud: its baud rate.
        exceptions: answer bad requests with exceptions; the manual says it stays silent.
    """

    thing = "a 2F-85"

    def __init__(
        self,
        device_id: int = 9,
        *,
        name: str = "",
        width_m: float = table.STROKE_M,
        t: float = 0.0,
        baud: int = 115_200,
        exceptions: bool = False,
    ) -> None:
        super().__init__()
        self._device_id, self.name, self.baud, self.exceptions = device_id, name, baud, exceptions
        self.foreign = False
        """Whether another Modbus device, with other registers, has its id."""
        self._wanted = [0, 0, 0]
        self._taken = [0, 0, 0]
        self._take_at = _NEVER
        self._stretch = _Stretch(t, table.counts_of(width_m), table.counts_of(width_m), 1.0)
        self._then: list[float] = []
        self._moving = False
        self._contact = Contact.MOVING
        self._activated = self._activating = False
        self._fault = 0
        self._put: Object | None = None
        self._jammed = False
        self._frozen: int | None = None
        self._heard_at = t
        self._deaf_until = _NEVER

    @property
    def device_id(self) -> int:
        """Its slave id."""
        return self._device_id

    # --- registers

    @property
    def command(self) -> tuple[int, int, int]:
        """The three registers as written last."""
        action, position, how = self._wanted
        return action, position, how

    def write(self, address: int, values: Sequence[int], t: float) -> bool:
        """Apply registers at the next cycle; False, without a write, if they do not exist."""
        at = address - table.COMMAND
        if not (at >= 0 and at + len(values) <= table.REGISTERS and values):
            return False
        for number, value in enumerate(values, at):
            if number < len(self._wanted):
                self._wanted[number] = value
        self._take_at = min(self._take_at, t + CYCLE_S)
        return True

    def read(self, address: int, count: int, t: float) -> tuple[int, ...] | None:
        """The present values of registers; None if they do not exist."""
        for base, values in ((table.COMMAND, self.command), (table.STATUS, self.status(t))):
            at = address - base
            if at >= 0 and count > 0 and at + count <= table.REGISTERS:
                whole = (*values, *(0 for _ in range(table.REGISTERS - len(values))))
                return whole[at : at + count]
        return None

    def status(self, t: float) -> tuple[int, int, int]:
        """The three status registers."""
        action, position, _ = self._taken
        going = self._going
        state = 1 if self._activating else 3 if self._activated else 0
        contact = self._contact if going and self._activated else Contact.MOVING
        bits = (action >> 8 & table.ACTIVATE) | (table.GO if going else 0) | state << 4 | contact << 6
        shown = round(self.position(t)) if self._frozen is None else self._frozen
        return bits << 8, self._shown_fault << 8 | position & 0xFF, shown << 8 | self._current

    @property
    def _going(self) -> bool:
        return bool(self._taken[0] >> 8 & table.GO)

    @property
    def _shown_fault(self) -> int:
        if self._fault:
            return self._fault
        if self._going and self._activating:
            return table.DELAYED_FAULT
        if self._going and not self._activated:
            return table.NOT_ACTIVATED_FAULT
        return table.COMMUNICATION_FAULT if self._deaf_until < _NEVER else 0

    @property
    def _current(self) -> int:
        if self._moving:
            return _MOVING_CURRENT
        if self._contact in {Contact.OPENING, Contact.CLOSING} and self._going:
            return min(255, round(table.force_of(self._taken[2] & 0xFF) / 2))
        return 0

    # --- time

    def heard(self, t: float) -> None:
        """A request has arrived."""
        if t - self._heard_at > PATIENCE_S:
            self._deaf_until = t + CYCLE_S
        self._heard_at = t

    def next_due(self) -> float | None:
        """When `advance` should be called next."""
        due = min(self._take_at, self._deaf_until, self._stretch.ends if self._moving else _NEVER)
        return None if due == _NEVER else due

    def advance(self, t: float) -> None:
        """Run everything that is due."""
        while (due := self.next_due()) is not None and due <= t:
            if due == self._take_at:
                self._take_at = _NEVER
                self._take_over(due)
            elif due == self._deaf_until:
                self._deaf_until = _NEVER
            else:
                self._arrive(due)

    def position(self, t: float) -> float:
        """Where the fingers are, in counts."""
        return self._stretch.at(t)

    def _take_over(self, t: float) -> None:
        before, self._taken = self._taken, list(self._wanted)
        action = self._taken[0] >> 8
        if not action & table.ACTIVATE:
            self._deactivate(t)
        elif not before[0] >> 8 & table.ACTIVATE:
            self._begin_activation(t)
        elif self._activated and not self._going:
            self._halt(t)
        elif self._taken != before:
            self._go(t)

    def _deactivate(self, t: float) -> None:
        if self._activated or self._activating or self._fault:
            self.note("deactivated", t)
        self._activated = self._activating = False
        self._fault = 0
        self._halt(t)
        self._check_supply(t)

    def _begin_activation(self, t: float) -> None:
        if self._fault < table.MAJOR_FAULT:
            self.note("activating", t)
            self._activating = True
            self._then = [table.OPEN_COUNTS]
            self._run_to(table.CLOSED_COUNTS, ACTIVATION_COUNTS_S, t)

    def _go(self, t: float) -> None:
        """Move to the goal in the registers, if it is allowed to."""
        if self._activated and self._going and not self._fault:
            _, position, how = self._taken
            self._run_to(_within(position & 0xFF), table.speed_of(how >> 8), t)

    def _run_to(self, goal: float, speed: float, t: float) -> None:
        here = self.position(t)
        end = self._where_met(here, goal)
        self._contact = Contact.MOVING
        self._stretch = _Stretch(t, here, end, speed)
        if not self._moving and end != here:
            self._moving = True
            self.note("motion_started", t, f"to {table.width_of(end):.4f} m")
        elif end == here:
            self._arrive(t)

    def _where_met(self, here: float, goal: float) -> float:
        """Where the motion to a goal ends: there, or at the object, compressed as far as the force allows."""
        if self._jammed:
            return here
        if self._put is None or self._put.inside == (goal > here):
            return goal
        force_n = table.force_of(self._taken[2] & 0xFF)
        surface = table.counts_of(self._put.width_m)
        pressed = table.counts_of(0.0) - table.counts_of(force_n / self._put.stiffness_n_m)
        if goal > here:
            return here if here >= surface + pressed else min(goal, surface + pressed)
        return here if here <= surface - pressed else max(goal, surface - pressed)

    def _arrive(self, t: float) -> None:
        if self._then:
            self._run_to(self._then.pop(0), ACTIVATION_COUNTS_S, t)
            return
        if self._activating:
            self._activating, self._activated = False, True
            self.note("activated", t)
            self._rest(t, "activated")
            self._go(t)
            return
        goal, end = _within(self._taken[1] & 0xFF), self._stretch.goal
        met = Contact.CLOSING if goal > end else Contact.OPENING
        self._contact = Contact.ARRIVED if abs(goal - end) < _CLOSE_COUNTS else met
        self._rest(t, self._contact.name.lower())

    def _halt(self, t: float) -> None:
        here = self.position(t)
        self._stretch, self._then = _Stretch(t, here, here, 1.0), []
        self._contact = Contact.MOVING
        self._rest(t, "halted")

    def _rest(self, t: float, reason: str) -> None:
        if self._moving:
            self._moving = False
            self.note("at_rest", t, reason)

    # --- the world

    def put(self, what: Object | None, t: float) -> None:
        """Put an object between the fingers, or take it away; moving or gripping fingers react to that."""
        self._put = what
        self._go(t)

    def _do_rare(self, command: faults.Command, t: float) -> None:
        match command:
            case faults.HardwareFault():
                self.fail(command.bits, t)
            case faults.Put(width_m=None):
                self.put(None, t)
            case faults.Put(width_m=float(width_m)):
                self.put(Object(width_m, command.stiffness_n_m, command.inside), t)
            case _:
                super()._do_rare(command, t)

    def wrong_model(self, number: int) -> None:  # noqa: ARG002 - a Modbus device has none
        """Be another Modbus device, with other registers."""
        self.foreign = True

    def jam(self, on: bool, t: float) -> None:
        """Jam the fingers, or release them."""
        self._jammed = on
        self._go(t)

    def freeze(self, on: bool, t: float, *, tick: bool = False) -> None:  # noqa: ARG002 - it has no clock to show
        """Freeze the position that it reports."""
        self._frozen = round(self.position(t)) if on else None

    def fail(self, fault: int, t: float) -> None:
        """Latch a fault and stop the fingers; after a major one it has to be activated again."""
        self._fault = fault
        if fault >= table.MAJOR_FAULT:
            self._activated = self._activating = False
        self._halt(t)
        self.note("fault", t, f"{fault:#04x}")

    def _check_supply(self, t: float) -> None:
        """Fail, unless it has failed already, while its supply or its housing is outside of its limits."""
        if self._fault == table.HOT_FAULT and self.temperature_c < COOL_C:
            self._fault = 0
        if self.supply_v < LEAST_V and self._fault < table.MAJOR_FAULT:
            self.fail(table.LOW_VOLTAGE_FAULT, t)
        elif self.temperature_c >= HOT_C and not self._fault:
            self.fail(table.HOT_FAULT, t)

    def _restore(self, t: float) -> None:  # noqa: ARG002 - at once
        """End all faults except a major one, which only a new activation clears."""
        self.foreign = False
        self.supply_v, self.temperature_c = self.healthy
        if self._fault < table.MAJOR_FAULT:
            self._fault = 0

    def brown_out(self, t: float) -> None:
        """The supply dips: the registers are 0, the fingers stop, and it has to be activated again."""
        self._wanted, self._taken, self._take_at = [0, 0, 0], [0, 0, 0], _NEVER
        self._activated = self._activating = False
        self._fault = 0
        self._halt(t)
        self.note("brown_out", t)

    def note(self, name: str, t: float, detail: str = "") -> None:
        """Log an event, with where the fingers are."""
        counts = self.position(t)
        entry = LogEntry(
            t,
            "",
            "event",
            name,
            self.device_id,
            joint=self.name,
            position_counts=round(counts),
            width_m=table.width_of(counts),
            detail=detail,
        )
        self.emit(entry)

    def state(self, t: float) -> GripperTruth:
        """Its actual state, now."""
        self.advance(t)
        going = self._going and self._activated
        return GripperTruth(
            device_id=self.device_id,
            gripper=self.name,
            width_m=table.width_of(self.position(t)),
            goal_counts=self._taken[1] & 0xFF,
            position_counts=round(self.position(t)),
            activated=self._activated,
            moving=self._moving,
            holding=going and self._contact in {Contact.OPENING, Contact.CLOSING},
            object_m=None if self._put is None else self._put.width_m,
            force_n=table.force_of(self._taken[2] & 0xFF),
            fault=self._shown_fault,
            absent=self.absent,
        )
