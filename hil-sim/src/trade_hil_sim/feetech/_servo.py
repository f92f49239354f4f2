"""One simulated servo: how it carries out instructions, and what it does by itself as time passes.

Where the sources leave a choice, the one that is harder on a driver was taken; docs/simulators.md lists them.
"""

from collections.abc import Callable, Iterator
from typing import Final

from trade_hil_sim.mechanics._truth import DeviceState

from ._memory import Memory
from ._shaft import Shaft
from ._table import BAUDS, CENTRE, RAD_PER_COUNT, STS3215, Model

__all__ = ["MOTION", "Emit", "Servo", "Status"]

RETURN_DELAY_UNIT_S: Final = 2e-6
PROTECTION_UNIT_S: Final = 0.01
BOOT_S: Final = 0.1
"""How long it hears nothing after a reboot: an assumption."""
TAKE_FOR_CENTRE: Final = 128
MOTION: Final = frozenset({"torque_enable", "goal_position"})
"""A write to any of these could set something moving, or let go of it."""

Emit = Callable[["Servo", str, float, str], None]


class Status:
    """Bits of register 65, of every answer, and of the unload condition, register 19."""

    VOLTAGE: Final = 0x01
    ENCODER: Final = 0x02
    TEMPERATURE: Final = 0x04
    CURRENT: Final = 0x08
    OVERLOAD: Final = 0x20


def _nowhere(servo: "Servo", name: str, t: float, detail: str) -> None:
    pass


class Servo:
    """A servo, fresh from the box but for its id, baud rate and position: torque off, position mode.

    Args:
        device_id: 0 to 253.
        model: which memory table.
        position_counts: where the shaft stands at the beginning; 2048 is the centre.
        baud: one of the rates register 6 knows.
        joint: name of the joint it drives, for logs.
        reversed_: whether the joint turns against the device.
        offset_rad: joint angle when the device reads its centre.
        t: the time, in seconds, on the clock of all later calls.
        goal_switches_on: a goal written while torque is off switches it on, as on real servos; else it is only kept.
        emit: told what happens: servo, event, time, detail.
    """

    def __init__(
        self,
        device_id: int,
        model: Model = STS3215,
        *,
        position_counts: float = CENTRE,
        baud: int = 1_000_000,
        joint: str = "",
        reversed_: bool = False,
        offset_rad: float = 0.0,
        t: float = 0.0,
        goal_switches_on: bool = True,
        emit: Emit = _nowhere,
    ) -> None:
        self.model, self.joint, self.emit = model, joint, emit
        self.goal_switches_on = goal_switches_on
        self._sign, self._offset_rad = -1 if reversed_ else 1, offset_rad
        self.memory = Memory(model)
        for name, value in (("id", device_id), ("baud_rate", BAUDS.index(baud))):
            self.memory.set(name, value)
            self.memory.keep(name)
        self.absent = False
        self.shaft = Shaft(self.memory, position_counts, t)
        self._underway = False
        self._registered: tuple[int, bytes] | None = None
        self._boots_at: float | None = None
        self._strains_since: float | None = None
        self._latched = 0
        self._strained_towards = 0.0
        self._start_ram(t)

    # what it is

    @property
    def device_id(self) -> int:
        """Its id on the bus, register 5."""
        return self.memory.get("id")

    @property
    def baud(self) -> int:
        """Bits per second it listens at, register 6."""
        return BAUDS[self.memory.get("baud_rate")]

    @property
    def return_delay_s(self) -> float:
        """Its pause before an answer, register 7."""
        return self.memory.get("return_delay_time") * RETURN_DELAY_UNIT_S

    @property
    def answers_all(self) -> bool:
        """Whether it answers more than pings and reads, register 8."""
        return self.memory.get("status_level") == 1

    @property
    def torque(self) -> bool:
        """Whether the motor is switched on; its protection may have cut it off all the same."""
        return self.memory.get("torque_enable") != 0

    @property
    def hears(self) -> bool:
        """Whether it is there and awake."""
        return not self.absent and self._boots_at is None

    @property
    def status(self) -> int:
        """What it complains of: the bits of register 65."""
        shaft, limit = self.shaft, self.memory.get
        bits = self._latched
        if not limit("min_voltage") <= shaft.supply_v * 10 <= limit("max_voltage"):
            bits |= Status.VOLTAGE
        if shaft.temperature_c > limit("max_temperature"):
            bits |= Status.TEMPERATURE
        return bits

    @property
    def _share(self) -> float:
        """Of the motor's torque, what its protection leaves."""
        cut = self.status & self.memory.get("unload_condition")
        if cut & ~Status.OVERLOAD:
            return 0.0
        return self.memory.get("protective_torque") / 100 if cut else 1.0

    def counts(self, t: float) -> int:
        """Where the shaft really is, in counts."""
        return round(self.shaft.position(t))

    def joint_rad(self, t: float) -> float:
        """The joint's angle where the shaft really is."""
        return self._offset_rad + self._sign * (self.shaft.position(t) - CENTRE) * RAD_PER_COUNT

    def state(self, t: float) -> DeviceState:
        """The truth about it, at time `t`."""
        self.advance(t)
        return DeviceState(
            device_id=self.device_id,
            joint=self.joint,
            model=self.model.name,
            position_counts=self.counts(t),
            position_rad=self.joint_rad(t),
            velocity_rad_s=self._sign * self.shaft.speed(t) * RAD_PER_COUNT,
            goal_counts=self.memory.get("goal_position"),
            torque=self.torque,
            moving=self.shaft.moving(t),
            operating_mode=self.memory.get("mode"),
            hardware_error=self.status,
            watchdog=0,
            absent=self.absent,
        )

    # time

    def next_due(self) -> float | None:
        """When it will next do something by itself."""
        return min((t for t, _ in self._dues()), default=None)

    def advance(self, t: float) -> None:
        """Let happen what is due by time `t`, in order."""
        while due := [due for due in self._dues() if due[0] <= t]:
            when, happen = min(due, key=lambda due: due[0])
            happen(when)

    def _dues(self) -> Iterator[tuple[float, Callable[[float], None]]]:
        if self._underway:
            yield self.shaft.course.ends, self._arrive
        if self._boots_at is not None:
            yield self._boots_at, self._boot
        if self._strains_since is not None:
            yield self._strains_since + self.memory.get("protection_time") * PROTECTION_UNIT_S, self._overload

    def _arrive(self, t: float) -> None:
        self._underway = False
        self.emit(self, "at_rest", t, "")

    def _boot(self, t: float) -> None:
        self._boots_at = None
        self._start_ram(t)
        self.emit(self, "booted", t, "")

    def _overload(self, t: float) -> None:
        self._strains_since = None
        self.fail(Status.OVERLOAD, t)

    # instructions

    def read(self, address: int, length: int, t: float) -> bytes:
        """Bytes of the memory table."""
        self.advance(t)
        self.shaft.refresh(t, on=self.torque and self._share > 0)
        self.memory.set("status", self.status)
        self.memory.set("async_write_flag", int(self._registered is not None))
        return self.memory.read(address, length)

    def write(self, address: int, data: bytes, t: float) -> None:
        """Write to the memory table what can be written; the rest stays as it is, and no answer tells of it."""
        self.advance(t)
        changes, refused = self.memory.plan(address, data)
        if refused or not changes:
            self.emit(self, "refused", t, f"no such write: {', '.join(refused) or address}")
        if changes.get("torque_enable", 0) not in {0, 1, TAKE_FOR_CENTRE}:
            del changes["torque_enable"]
        kept = self.memory.get("lock") == 0
        torque = changes.pop("torque_enable", None)
        for name, value in changes.items():
            self.memory.set(name, value)
            if kept and self.model.by_name[name].eeprom:
                self.memory.keep(name)
        if torque is not None:
            self._switch(torque, t)
        elif "goal_position" in changes and (self.torque or self.goal_switches_on):
            self._switch(1, t)

    def reg_write(self, address: int, data: bytes) -> None:
        """Keep a write for later."""
        self._registered = (address, data)

    @property
    def registered(self) -> tuple[int, bytes] | None:
        """The write kept for later, if any: address and data."""
        return self._registered

    def action(self, t: float) -> None:
        """Carry out the write kept, if there is one."""
        kept, self._registered = self._registered, None
        if kept is not None:
            self.write(*kept, t)

    def reboot(self, t: float, event: str = "rebooted") -> None:
        """Lose the RAM area, let go of the shaft, and hear nothing for a moment."""
        self.emit(self, event, t, "")
        self._release(t)
        self.memory.set("torque_enable", 0)
        self._boots_at = t + BOOT_S

    def factory_reset(self, t: float) -> None:
        """Restore all registers but the id."""
        self.memory.factory_reset(spared=("id",))
        self.reboot(t, "factory_reset")

    # faults

    def fail(self, bits: int, t: float) -> None:
        """Latch complaints; those named in the unload condition (19) cut the motor off."""
        self._strained_towards = self.shaft.ahead(t)
        self._complain(t, lambda: setattr(self, "_latched", self._latched | bits))

    def set_supply(self, t: float, *, voltage_v: float | None = None, temperature_c: int | None = None) -> None:
        """Change what it measures of its supply and housing; it complains while that is outside its limits."""
        shaft = self.shaft

        def change() -> None:
            shaft.supply_v = shaft.supply_v if voltage_v is None else voltage_v
            shaft.temperature_c = shaft.temperature_c if temperature_c is None else temperature_c

        self._complain(t, change)

    def place(self, position_counts: int, t: float) -> None:
        """Turn the shaft by hand; with torque on it goes back to its goal."""
        self.shaft.place(position_counts, t)
        self.emit(self, "placed", t, "")
        self._set_off(t) if self.torque else self._note_motion(t)

    def jam(self, on: bool, t: float) -> None:
        """Hold the shaft fast, or let go of it."""
        if on == self.shaft.jammed:
            return
        self.shaft.jammed = on
        if on:
            self.shaft.place(self.shaft.position(t), t)
            self._note_motion(t)
        self._strains_since = t if self.torque and self.shaft.strains(t) else None
        if not on and self.torque:
            self._set_off(t)

    def freeze_sensor(self, on: bool, t: float) -> None:
        """Let the position register stand still, or show the truth again."""
        self.shaft.freeze_sensor(t) if on else self.shaft.thaw_sensor()

    # inside

    def _complain(self, t: float, change: Callable[[], None]) -> None:
        before = self._share
        change()
        if self._share < before:
            self.emit(self, "shutdown", t, f"status {self.status:#04x}")
        if self._share != before and self.torque:
            self._set_off(t)

    def _switch(self, value: int, t: float) -> None:
        if value == TAKE_FOR_CENTRE:
            self.shaft.take_for_centre(t)
        elif value == 0 and self.torque:
            self.memory.set("torque_enable", 0)
            self._latched &= ~Status.OVERLOAD
            self.emit(self, "torque_off", t, "")
            self._release(t)
        elif value:
            if not self.torque:
                self.memory.set("torque_enable", 1)
                self.emit(self, "torque_on", t, "")
            self._set_off(t)

    def _set_off(self, t: float) -> None:
        if self._latched & Status.OVERLOAD and self.shaft.ahead(t) * self._strained_towards < 0:
            self._latched &= ~Status.OVERLOAD
        if (share := self._share) == 0:
            self._release(t)
            return
        self.shaft.follow(t, share)
        self._strains_since = t if self.shaft.strains(t) and not self._latched & Status.OVERLOAD else None
        self._note_motion(t)

    def _release(self, t: float) -> None:
        self._strains_since = None
        self.shaft.stop(t)
        self._note_motion(t)

    def _note_motion(self, t: float) -> None:
        if not self._underway and self.shaft.moving(t):
            self._underway = True
            self.emit(self, "motion_started", t, f"goal position {self.memory.get('goal_position')}")
        elif self._underway and not self.shaft.moving(t):
            self._arrive(t)

    def _start_ram(self, t: float) -> None:
        self.memory.lose_power()
        self._registered, self._latched = None, 0
        self.memory.set("goal_position", self.counts(t))
