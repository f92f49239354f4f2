"""One simulated servo: how it carries out instructions, and its behaviour over time.

Where the sources leave a choice, the one that is harder on a driver was taken; docs/simulators.md lists them.
"""

from typing import Final

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.mechanics._device import Controller, Emit, unheard
from trade_hil_sim.serial._servo import CENTRE, ServoModel

from ._memory import MemoryTable
from ._shaft import Shaft
from ._table import BAUDS, STS3215, Model

PROTECTION_UNIT_S: Final = 0.01
TAKE_FOR_CENTRE: Final = 128
MOTION: Final = frozenset({"torque_enable", "goal_position"})
"""A write to any of these could start a motion, or switch off torque."""


class Status:
    """Bits of register 65, of every answer, and of the unload condition, register 19."""

    VOLTAGE: Final = 0x01
    ENCODER: Final = 0x02
    TEMPERATURE: Final = 0x04
    CURRENT: Final = 0x08
    OVERLOAD: Final = 0x20


class Servo(ServoModel[MemoryTable, Shaft]):
    """A servo with factory settings except its id, baud rate and position: torque off, position mode.

    Args:
        device_id: 0 to 253.
        model: which memory table.
        position_counts: the initial position of the shaft; 2048 is the centre.
        baud: one of the rates register 6 knows.
        joint: name of the joint it drives, for logs.
        reversed_: whether the joint turns against the device.
        offset_rad: joint angle when the device reads its centre.
        t: the time, in seconds, on the clock of all later calls.
        goal_switches_on: a goal written while torque is off switches it on, as on real servos; else it is only kept.
        emit: called with each event.
    """

    firmware = ("firmware_major", "firmware_minor")

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
        emit: Emit = unheard,
    ) -> None:
        memory = MemoryTable(model)
        for name, value in (("id", device_id), ("baud_rate", BAUDS.index(baud))):
            memory.set(name, value)
            memory.keep(name)
        super().__init__(
            memory,
            Shaft(memory, position_counts, t),
            model=model.name,
            supply_v=model.supply_v,
            joint=joint,
            reversed_=reversed_,
            offset_rad=offset_rad,
            emit=emit,
        )
        self.model, self.thing = model, f"an {model.name}"
        self.goal_switches_on = goal_switches_on
        self._latched = 0
        self._strained_towards = 0.0
        self._start_ram(t)

    # properties

    @property
    def baud(self) -> int:
        """Bits per second it listens at, register 6."""
        return BAUDS[self.memory.get("baud_rate")]

    @property
    def answers_all(self) -> bool:
        """Whether it answers more than pings and reads, register 8."""
        return self.memory.get("status_level") == 1

    @property
    def status(self) -> int:
        """Its latched errors: the bits of register 65."""
        limit = self.memory.get
        bits = self._latched
        if not limit("min_voltage") <= self.supply_v * 10 <= limit("max_voltage"):
            bits |= Status.VOLTAGE
        if self.temperature_c > limit("max_temperature"):
            bits |= Status.TEMPERATURE
        return bits

    @property
    def _share(self) -> float:
        """The fraction of the motor's torque that its protection allows."""
        cut = self.status & self.memory.get("unload_condition")
        if cut & ~Status.OVERLOAD:
            return 0.0
        return self.memory.get("protective_torque") / 100 if cut else 1.0

    @property
    def overload_s(self) -> float:
        """How long it pushes against a jam before an overload, register 35."""
        return self.memory.get("protection_time") * PROTECTION_UNIT_S

    def _controller(self) -> Controller:
        return Controller(
            goal_counts=self.memory.get("goal_position"),
            torque=self.torque,
            operating_mode=self.memory.get("mode"),
            hardware_error=self.status,
            watchdog=0,
        )

    # instructions

    def read(self, address: int, length: int, t: float) -> bytes:
        """Bytes of the memory table."""
        self.advance(t)
        self.shaft.refresh(t, on=self.torque and self._share > 0)
        self.memory.set("present_voltage", round(self.supply_v * 10))
        self.memory.set("present_temperature", self.temperature_c)
        self.memory.set("status", self.status)
        self.memory.set("async_write_flag", int(self._registered is not None))
        return self.memory.read(address, length)

    def write(self, address: int, data: bytes, t: float) -> None:
        """Write to the memory table what can be written; the rest stays as it is, and no answer reports that."""
        self.advance(t)
        changes, refused = self.memory.plan(address, data)
        if refused or not changes:
            self.note("refused", t, f"no such write: {', '.join(refused) or address}")
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

    def action(self, t: float) -> None:
        """Carry out the write kept, if there is one."""
        kept, self._registered = self._registered, None
        if kept is not None:
            self.write(*kept, t)

    def factory_reset(self, t: float) -> None:
        """Restore all registers but the id."""
        self.memory.factory_reset(spared=("id", *self.firmware))
        self.reboot(t, "factory_reset")

    # faults

    def do(self, command: faults.Command, t: float) -> None:
        """Carry out a fault or an order; there is no clock to freeze."""
        if isinstance(command, faults.Freeze) and command.tick:
            raise self._refusal(command)
        super().do(command, t)

    def fail(self, bits: int, t: float) -> None:
        """Latch errors; those named in the unload condition (19) switch the motor off."""
        self._strained_towards, before = self.shaft.ahead(t), self._share
        self._latched |= bits
        self._complain(t, before)

    def set_supply(self, t: float, *, voltage_v: float | None = None, temperature_c: int | None = None) -> None:
        """Change what it measures of its supply and housing; it reports an error while that is outside its limits."""
        before = self._share
        super().set_supply(t, voltage_v=voltage_v, temperature_c=temperature_c)
        self._complain(t, before)

    # inside

    def _complain(self, t: float, before: float) -> None:
        """Apply its overload protection; the argument is the fraction of torque that it allowed before."""
        if self._share < before:
            self.note("shutdown", t, f"status {self.status:#04x}")
        if self._share != before and self.torque:
            self._set_off(t)

    def _switch(self, value: int, t: float) -> None:
        if value == TAKE_FOR_CENTRE:
            self.shaft.take_for_centre(t)
        elif value == 0 and self.torque:
            self.memory.set("torque_enable", 0)
            self._latched &= ~Status.OVERLOAD
            self.note("torque_off", t)
            self._release(t)
        elif value:
            if not self.torque:
                self.memory.set("torque_enable", 1)
                self.note("torque_on", t)
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

    def _start_ram(self, t: float) -> None:
        self.memory.lose_power()
        self._registered, self._latched = None, 0
        self.memory.set("goal_position", self.counts(t))
