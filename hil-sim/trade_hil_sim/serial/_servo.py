"""A servo of any vendor with a table of registers: its shaft, and its behaviour over time."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from math import copysign, tau
from typing import ClassVar, Final, Generic, TypeVar

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.mechanics._device import Emit, JointModel, version_of
from trade_hil_sim.mechanics._profile import Course, to_speed
from trade_hil_sim.serial._device_bus import LineDevice
from trade_hil_sim.serial._registers import Memory, Register
from trade_robotfile import Joint

COUNTS_PER_TURN: Final = 4096
CENTRE: Final = 2048
RAD_PER_COUNT: Final = tau / COUNTS_PER_TURN
QUICK_COUNTS_S2: Final = 200.0 / RAD_PER_COUNT
"""The most a servo's motor accelerates its shaft, 200 rad/s^2: an assumption, no data sheet gives it."""
IN_POSITION_COUNTS: Final = 10
RETURN_DELAY_UNIT_S: Final = 2e-6
BOOT_S: Final = 0.1
"""How long it receives nothing after a reboot: an assumption."""
OVERLOAD: Final = 0x20
"""Bit of an overload in the error registers of all these servos."""


class ServoShaft(ABC):
    """The shaft of one servo and the controller that turns it.

    There is no thread and no integration: a course is planned when a goal is written, and positions are computed from
    the clock when they are read.
    """

    direction = 1
    """-1: positive counts turn the other way."""
    tolerance = IN_POSITION_COUNTS
    """The position error that a held shaft may have without overload."""

    def __init__(self, course: Course) -> None:
        self.course = course
        self.jammed = False
        self._shown: float | None = None

    @abstractmethod
    def position(self, t: float) -> float:
        """Where the shaft is, in counts of the register that shows it, unrounded."""

    @abstractmethod
    def place(self, position_counts: float, t: float) -> None:
        """Put the shaft somewhere, at rest."""

    @abstractmethod
    def ahead(self, t: float) -> float:
        """The distance to the goal in counts, or the target speed, with its sign."""

    def speed(self, t: float) -> float:
        """How fast it turns, in counts/s."""
        return self.direction * self.course.at(t)[1]

    def moving(self, t: float) -> bool:
        """Whether the shaft turns, or is about to."""
        return t < self.course.ends or self.course.final_speed != 0.0

    def stop(self, t: float) -> None:
        """Come to rest as fast as the motor can."""
        position, speed, _ = self.course.at(t)
        self.course = to_speed(t, position, speed, 0.0, QUICK_COUNTS_S2)

    def strains(self, t: float) -> bool:
        """Whether a jam keeps it from its target position or speed."""
        return self.jammed and abs(self.ahead(t)) > self.tolerance

    def freeze(self, on: bool, t: float) -> None:
        """Freeze the position register, or show the truth again."""
        self._shown = self.position(t) if on else None

    def _effort(self, t: float) -> float:
        """Load between -1 and 1: full against a jam, else for acceleration and a little for friction."""
        _, speed, acceleration = self.course.at(t)
        if self.strains(t):
            return copysign(1.0, self.ahead(t))
        friction = 0.05 * ((speed > 0) - (speed < 0))
        return self.direction * max(-1.0, min(1.0, friction + 0.5 * acceleration / QUICK_COUNTS_S2))


_Memory_co = TypeVar("_Memory_co", bound=Memory[Register], covariant=True)
_Shaft_co = TypeVar("_Shaft_co", bound=ServoShaft, covariant=True)


class ServoModel(JointModel, LineDevice, Generic[_Memory_co, _Shaft_co]):
    """A servo with factory settings except its id, baud rate and position: torque off, position mode.

    Args:
        memory: its registers.
        shaft: what it moves.
        model: its name.
        supply_v: its nominal supply.
        joint: name of the joint it drives, for logs.
        reversed_: whether the joint turns against the device.
        offset_rad: joint angle when the device reads its centre.
        emit: called with each event.
    """

    firmware: ClassVar[tuple[str, ...]]
    """The registers of its firmware version, major number first."""
    overload_s = 1.0
    """How long it pushes against a jam before an overload."""

    def __init__(
        self,
        memory: _Memory_co,
        shaft: _Shaft_co,
        *,
        model: str,
        supply_v: float,
        joint: str,
        reversed_: bool,
        offset_rad: float,
        emit: Emit,
    ) -> None:
        super().__init__(joint, model, (-1 if reversed_ else 1) * RAD_PER_COUNT, offset_rad)
        self.memory, self.shaft, self.emit = memory, shaft, emit
        self.supply_v = supply_v
        self._model_number = memory.get("model_number")
        self._registered: tuple[int, bytes] | None = None
        self._boots_at: float | None = None
        self._strains_since: float | None = None

    def resemble(self, joint: Joint, t: float) -> None:
        """Become the device of a robot file: its homing offset, and its firmware if the file names one.

        Raises:
            SimulationError: the registers cannot have such a value.
        """
        position = self.shaft.position(t)
        values = {"homing_offset": joint.homing_counts}
        if joint.firmware is not None:
            values |= zip(self.firmware, version_of(joint, len(self.firmware)), strict=True)
        for name, value in values.items():
            self.memory.set(name, value)
            self.memory.keep(name)
            if self.memory.get(name) != value:
                key = "homing_counts" if name == "homing_offset" else "firmware"
                raise faults.SimulationError(f'joint."{joint.name}".{key}: {value} does not fit into {self.thing}')
        self.shaft.place(position, t)
        self._start_ram(t)

    # properties

    @property
    def device_id(self) -> int:
        """Its id on the bus."""
        return self.memory.get("id")

    @property
    @abstractmethod
    def baud(self) -> int:
        """Bits per second it listens at."""

    @property
    def shadow_id(self) -> int | None:
        """The second id it obeys writes to, if there is one."""
        return None

    @property
    def return_delay_s(self) -> float:
        """Its pause before an answer."""
        return self.memory.get("return_delay_time") * RETURN_DELAY_UNIT_S

    @property
    def torque(self) -> bool:
        """Whether torque is enabled; its protection may still have switched the motor off."""
        return self.memory.get("torque_enable") != 0

    @property
    def hears(self) -> bool:
        """Whether it is on the bus and not rebooting."""
        return not self.absent and self._boots_at is None

    @property
    def registered(self) -> tuple[int, bytes] | None:
        """The write kept for later, if any: address and data."""
        return self._registered

    def counts(self, t: float) -> int:
        """Where the shaft really is, in counts."""
        return round(self.shaft.position(t))

    def _units(self, t: float) -> tuple[float, float]:
        return self.shaft.position(t) - CENTRE, self.shaft.speed(t)

    def _moving(self, t: float) -> bool:
        return self.shaft.moving(t)

    def _bound_for(self) -> str:
        return f"goal position {self.memory.get('goal_position')}"

    # time

    def next_due(self) -> float | None:
        """When `advance` should be called next."""
        return min((t for t, _ in self._dues()), default=None)

    def advance(self, t: float) -> None:
        """Run everything that is due by time `t`, in order."""
        while due := min((due for due in self._dues() if due[0] <= t), key=lambda due: due[0], default=None):
            when, happen = due
            happen(when)

    def _dues(self) -> Iterator[tuple[float, Callable[[float], None]]]:
        if self._underway and self.shaft.course.final_speed == 0.0:
            yield self.shaft.course.ends, self._note_motion
        if self._boots_at is not None:
            yield self._boots_at, self._boot
        if self._strains_since is not None:
            yield self._strains_since + self.overload_s, self._overload

    def _boot(self, t: float) -> None:
        self._boots_at = None
        self._start_ram(t)
        self.note("booted", t)

    def _overload(self, t: float) -> None:
        self._strains_since = None
        self.fail(OVERLOAD, t)

    @abstractmethod
    def _start_ram(self, t: float) -> None:
        """Start with the RAM at its defaults."""

    def reboot(self, t: float, event: str = "rebooted") -> None:
        """Lose the RAM area and the torque, and receive nothing for a moment."""
        self.note(event, t)
        self._release(t)
        self.memory.set("torque_enable", 0)
        self._boots_at = t + BOOT_S

    # faults

    def _do_rare(self, command: faults.Command, t: float) -> None:
        match command:
            case faults.HardwareFault():
                self.fail(command.bits, t)
            case faults.Place():
                self.place(command.counts, t)
            case _:
                super()._do_rare(command, t)

    @abstractmethod
    def fail(self, bits: int, t: float) -> None:
        """Latch errors."""

    def place(self, position_counts: int, t: float) -> None:
        """Turn the shaft by hand; with torque on it goes back to its goal."""
        self.shaft.place(position_counts, t)
        self.note("placed", t)
        self._set_off(t) if self.torque else self._note_motion(t)

    def jam(self, on: bool, t: float) -> None:
        """Jam the shaft, or release it."""
        if on == self.shaft.jammed:
            return
        self.shaft.jammed = on
        if on:
            self.shaft.place(self.shaft.position(t), t)
            self._note_motion(t)
        self._strains_since = t if self.torque and self.shaft.strains(t) else None
        if not on and self.torque:
            self._set_off(t)

    def freeze(self, on: bool, t: float, *, tick: bool = False) -> None:  # noqa: ARG002 - not all have a clock
        """Freeze the position register, or show the truth again."""
        self.shaft.freeze(on, t)

    def wrong_model(self, number: int) -> None:
        """Report another model number."""
        self.memory.set("model_number", number)

    def brown_out(self, t: float) -> None:
        """Lose power for a moment."""
        self.reboot(t, "brown_out")

    def _restore(self, t: float) -> None:  # noqa: ARG002 - at once
        self.wrong_model(self._model_number)

    @abstractmethod
    def _set_off(self, t: float) -> None:
        """Move to the goal, if it is allowed to."""

    def _release(self, t: float) -> None:
        self._strains_since = None
        self.shaft.stop(t)
        self._note_motion(t)
