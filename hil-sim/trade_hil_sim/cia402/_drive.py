"""A servo drive (CiA 402): state machine, modes, faults and sensors, behind a CANopen node. Time is an argument."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, tau
from typing import Final

from trade_hil_sim.can import Frame, JointDevice
from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.mechanics._device import Controller
from trade_hil_sim.mechanics._shaft import Shaft

from ._machine import Command, Machine, State
from ._modes import MOTION, Mode, Modes
from ._node import Node
from ._objects import OBJECTS, SUPPORTED_MODES, Object, pdo_objects
from ._store import Abort, AbortCode, Store

VOLTAGE_ON: Final = 1 << 4
NO_QUICK_STOP: Final = 1 << 5
REMOTE: Final = 1 << 9
MODE_LAG_S: Final = 0.004
"""Time between the request for a mode and its display: a drive needs a while to change."""
LOOK_S: Final = 0.005
"""How often a drive checks its following error."""
FOLLOWING_ERROR: Final = 0x8611
LINK_FAULT: Final = 0x8130
OVER_VOLTAGE: Final = 0x3210
UNDER_VOLTAGE: Final = 0x3220
TOO_HOT: Final = 0x4310
VOLTS: Final = (18.0, 60.0)
HOTTEST_C: Final = 85
FULL: Final = 1000
PRODUCT: Final = 402
FIRMWARE: Final = "0.1.0"
"""Its software version (100Ah), unless a robot file names another one."""


def _named(model: str, firmware: str, serial_number: int) -> list[Object]:
    """The objects of a drive that identifies as this one."""
    own = {"device_name": model.encode(), "software_version": firmware.encode(), "serial_number": serial_number}
    return [replace(o, default=own.get(o.name, o.default)) for o in OBJECTS]


class Drive(JointDevice):
    """One drive; it boots when created.

    Args:
        device_id: its node id, 1 to 127.
        joint: name of the joint, for the log.
        model: what it is called.
        firmware: its software version, object 100Ah.
        serial_number: object 1018h.
        counts_per_rev: counts of the encoder for one turn of the motor.
        gear: turns of the motor for one turn of the joint.
        position_counts: where the shaft is at first.
        reversed_: whether the joint turns against the counts.
        offset_rad: the joint's angle at 0 counts.
        t: now, in seconds.
    """

    thing = "a CiA 402 drive"
    healthy = (48.0, 35)
    counts_per_unit = 1

    def __init__(
        self,
        device_id: int,
        *,
        joint: str = "",
        model: str = "CiA402",
        firmware: str = FIRMWARE,
        serial_number: int = 0,
        counts_per_rev: float = 4096.0,
        gear: float = 1.0,
        position_counts: float = 0.0,
        reversed_: bool = False,
        offset_rad: float = 0.0,
        t: float = 0.0,
    ) -> None:
        super().__init__(
            device_id,
            Shaft(position_counts, t),
            joint=joint,
            model=model,
            rad_per_unit=(-1 if reversed_ else 1) * tau / (counts_per_rev * gear),
            offset_rad=offset_rad,
        )
        self.due = t
        named = _named(model, firmware, serial_number)
        self.store = Store([*named, *pdo_objects(device_id)], counts_per_rev)
        self.modes = Modes(self.store, self._shaft, counts_per_rev, self.note)
        self._machine = Machine(self.store, self._shaft, self.modes, self.note)
        self.turn = counts_per_rev
        self._mode_due = self._look_due = inf
        self._behind_since: float | None = None
        self.node = Node(device_id, self.store, self, t)
        self._plan(t)

    def says(self, *objects: Object) -> None:
        """Have these objects, too, from now on: of its units (`unit_objects`), or its scale (`factor_objects`)."""
        self.store.add(objects)

    @property
    def state_now(self) -> State:
        """The state of its state machine."""
        return self._machine.state

    # the bus

    def hear(self, frame: Frame, t: float) -> None:
        """A frame has come."""
        if self.node.accepts(frame.can_id):
            if self.due <= t:
                self.advance(t)
            self.node.hear(frame, t)
            self._plan(t)

    def advance(self, t: float) -> None:
        """Run what is due."""
        if self._mode_due <= t:
            self._change_mode(t)
        self.modes.advance(t)
        self._machine.advance(t)
        if self._look_due <= t:
            self._look(t)
        self.node.advance(t)
        self._plan(t)

    def _plan(self, t: float) -> None:
        """Publish changes, and set when it is due next."""
        self._note_motion(t)
        self._show(t)
        self.node.changed(t)
        if not (self.state_now is State.OPERATION_ENABLED and self._shaft.parted):
            self._look_due = inf
            self._behind_since = None
        elif self._look_due == inf:
            self._look_due = t + LOOK_S
        rests = self._machine.due(t)
        self.due = min(rests, self._mode_due, self._look_due, self.modes.due, self.node.due, self.modes.next_show(t))

    # what the node asks

    def refresh(self, t: float) -> None:
        """Bring measured values up to date."""
        wanted, wanted_speed, acceleration = self._shaft.demand.at(t)
        position, speed = self._shaft.actual.at(t)[:2] if self._frozen is None else self._frozen
        torque = self._torque(acceleration)
        self.store.set("position_actual", round(position - self.modes.zero))
        self.store.set("velocity_actual", round(speed / self.store.unit("velocity_actual")))
        self.store.set("position_demand", round(wanted - self.modes.zero))
        self.store.set("velocity_demand", round(wanted_speed / self.store.unit("velocity_demand")))
        self.store.set("following_error", round(wanted - position))
        self.store.set("torque_actual", torque)
        self.store.set("current_actual", torque)
        self.store.set("dc_link_mv", round(self.supply_v * 1e3))

    def _torque(self, acceleration: float) -> int:
        most = self.store.get("max_torque")
        if not self._machine.powered:
            return 0
        if self.modes.mode in {Mode.PROFILE_TORQUE, Mode.CYCLIC_TORQUE}:
            return max(-most, min(most, self.store.get("target_torque")))
        if self._shaft.jammed and self._shaft.parted:
            return most
        return round(acceleration / self.store.rate("max_acceleration") * FULL)

    def check(self, entry: Object, value: int) -> None:
        """Refuse unsupported modes and methods; raises `Abort`."""
        if entry.name == "mode" and value not in SUPPORTED_MODES | {0}:
            raise Abort(AbortCode.VALUE)
        if entry.name in {"position_limit_min", "position_limit_max"}:
            low, high = self.store.get("position_limit_min"), self.store.get("position_limit_max")
            if value > high if entry.name == "position_limit_min" else value < low:
                raise Abort(AbortCode.VALUE)

    def written(self, name: str, values: Sequence[tuple[Object, int]], t: float) -> None:
        """Apply what a client has written, all at once."""
        changes = [entry.name for entry, value in values if self.store.get(entry.name) != value]
        if changes or name == "sdo_write":
            self._written(name, values, bool(MOTION.intersection(changes)), t)
        before = self.store.get("controlword")
        for entry, value in values:
            self.store.set(entry.name, value)
        names = {entry.name for entry, _ in values}
        if "mode" in names and self.store.get("mode") != self.modes.mode:
            self._mode_due = t + MODE_LAG_S
        if "controlword" in names:
            self._machine.obey(before, t, self.node)
        self.modes.written(names, before, t)

    def link_lost(self, reason: str, t: float) -> None:
        """React to the loss of the master: object 6007h says what a powered drive does."""
        match self.store.get("abort_connection_option") if self._machine.powered else 0:
            case 1:
                self._machine.fail(LINK_FAULT, t, None)
            case 2:
                self._machine.lead(Command.DISABLE_VOLTAGE, t)
            case 3:
                self._machine.lead(Command.QUICK_STOP, t)
            case _:
                self.note("unattended", t, reason)

    def link_back(self, t: float) -> None:
        """React to the master's return; a fault stays, whatever caused it."""
        if self.state_now not in {State.FAULT, State.FAULT_REACTION_ACTIVE}:
            self.node.emergency_over(t)

    def power_on(self, t: float) -> None:
        """Reset to the initial state; the shaft stays where it is."""
        self._mode_due = inf
        self._machine.enter(State.SWITCH_ON_DISABLED, t)
        self.modes.select(Mode.NONE, t)

    def put(self, frame: Frame, t: float) -> None:
        """Send a frame."""
        self.send(frame, t)

    def _change_mode(self, t: float) -> None:
        self._mode_due = inf
        wanted = self.store.get("mode")
        if wanted in SUPPORTED_MODES | {0}:
            self.modes.select(Mode(wanted), t)
            self.store.set("mode_display", wanted)

    def _show(self, t: float) -> None:
        """The statusword as it is now."""
        word = int(self.state_now) | VOLTAGE_ON | REMOTE | self.modes.bits(t)
        if self.state_now not in {State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE, State.FAULT}:
            word |= NO_QUICK_STOP
        self.store.set("statusword", word)

    # sensors and faults

    def _look(self, t: float) -> None:
        """Check the following error."""
        self._look_due = t + LOOK_S
        self._shaft.rejoin(t)
        if abs(self._shaft.behind(t)) <= self.store.get("following_error_window"):
            self._behind_since = None
            return
        self._behind_since = t if self._behind_since is None else self._behind_since
        if t - self._behind_since >= self.store.get("following_error_timeout_ms") / 1e3:
            self._machine.fail(FOLLOWING_ERROR, t, self.node)

    def _do_rare(self, command: faults.Command, t: float) -> None:
        match command:
            case faults.Emergency():
                if command.lasting:
                    self._machine.causes.add(command.code)
                self._machine.fail(command.code, t, self.node)
            case _:
                super()._do_rare(command, t)

    def freeze(self, on: bool, t: float, *, tick: bool = False) -> None:  # noqa: ARG002 - it has no clock to show
        """Freeze the measured position and speed, or show the truth again."""
        self._frozen = (self._shaft.position(t), self._shaft.speed(t)) if on else None

    def _bus_off(self, on: bool, t: float) -> None:
        super()._bus_off(on, t)
        if on:
            self.link_lost("bus-off", t)

    def jam(self, on: bool, t: float) -> None:
        """Jam the shaft, or release it."""
        self._shaft.jam(on, t)
        if not on and self.state_now is State.OPERATION_ENABLED:
            self.modes.enable(t)

    def _unjam(self, t: float) -> None:
        if self._shaft.jammed:
            self.jam(False, t)

    def _place(self, position: float, t: float) -> None:
        """Turn the shaft by hand; an enabled drive returns to its demand, or fails if that is too far."""
        demand = self._shaft.demand.at(t)[0]
        self._shaft.place(position + self.modes.zero, t)
        self.note("placed", t)
        if self.state_now is not State.OPERATION_ENABLED:
            self._shaft.forget(t)
        elif abs(self._shaft.behind(t)) > self.store.get("following_error_window"):
            self._machine.fail(FOLLOWING_ERROR, t, self.node)
        else:
            self._shaft.go(t, demand, self.store.rate("max_profile_velocity"), self.store.rate("max_acceleration"))

    def wrong_model(self, number: int) -> None:
        """Identify as another product."""
        self.store.set("product_code", number)

    def _lose_zero(self, position: float, t: float) -> None:
        self.modes.zero = self._shaft.position(t) - position

    def _restart(self, t: float) -> None:
        self.node.reset(t)

    def _check_supply(self, t: float) -> None:
        now = {
            OVER_VOLTAGE: self.supply_v > VOLTS[1],
            UNDER_VOLTAGE: self.supply_v < VOLTS[0],
            TOO_HOT: self.temperature_c > HOTTEST_C,
        }
        for code, wrong in now.items():
            if wrong and code not in self._machine.causes:
                self._machine.causes.add(code)
                self._machine.fail(code, t, self.node)
            elif not wrong:
                self._machine.causes.discard(code)

    def _restore(self, t: float) -> None:  # noqa: ARG002 - at once
        self.supply_v, self.temperature_c = self.healthy
        self._machine.causes.clear()
        self.wrong_model(PRODUCT)

    # the truth

    def _position(self, t: float) -> float:
        return self._shaft.position(t) - self.modes.zero

    def _written(self, name: str, values: Sequence[tuple[Object, int]], moves: bool, t: float) -> None:
        self._journal(
            name,
            b"".join(entry.encode(value) for entry, value in values),
            moves,
            t,
            address=values[0][0].index if name == "sdo_write" else None,
            registers=tuple(entry.name for entry, _ in values),
            position_counts=self.counts(t),
        )

    def _controller(self) -> Controller:
        return Controller(
            goal_counts=self.store.get("target_position"),
            torque=self._machine.powered,
            operating_mode=int(self.modes.mode),
            hardware_error=self.store.get("error_code"),
            watchdog=self.store.get("consumer_heartbeat_1") & 0xFFFF,
        )
