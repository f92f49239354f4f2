"""The exchange with a bus of Feetech servos: commands in each cycle, and the steps of enabling and relaxing.

They have no watchdog. So each cycle sends a moving joint only a little ahead, and the joint comes to rest by itself
soon after the cycles end, for example when the driver dies or freezes.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, NoReturn

from trade.errors import ConfigurationError, TradeError
from trade_drivers.joints import AwaitedJob, AxisMotion, Gate, Goal, Steps
from trade_drivers.joints.serial import ServoExchange, check_own_range
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import CYCLIC, FeetechAxis

if TYPE_CHECKING:
    from trade_drivers.vendors.feetech._wire import Wire  # noqa: F401 - a parameter of the base class

_SIZES: Final = tuple(register.end - CYCLIC[0] for register in (table.PRESENT_LOAD, table.TEMPERATURE, table.STATUS))
GOAL_BLOCK: Final = (table.ACCELERATION.address, table.GOAL_SPEED.end - table.ACCELERATION.address)
"""Address and size of a command to move: a goal always with its speed."""


class FeetechExchange(ServoExchange[FeetechAxis, "Wire"]):
    """The exchange with the Feetech servos of one bus."""

    sizes = _SIZES
    answer_overhead = 7

    # --- commands

    def write_goals(self, goals: Mapping[FeetechAxis, Goal], gate: Gate) -> None:
        now_ns = self.clock()
        self._send({axis: axis.step(aim, now_ns) for axis, aim in goals.items()}, gate)
        for axis, aim in goals.items():
            axis.aim = aim

    def write_positions(self, positions: Mapping[FeetechAxis, int], gate: Gate) -> None:
        goals: dict[FeetechAxis, Goal] = {}
        for axis, position in positions.items():
            aim = axis.aim
            accel, speed = (aim.accel, aim.speed) if aim else (axis.accel_counts, axis.speed_counts)
            goals[axis] = Goal(position, accel, speed)
        self.write_goals(goals, gate)

    def write_holds(self, positions: Mapping[FeetechAxis, int]) -> None:
        self._send({axis: axis.brake(position) for axis, position in positions.items()})
        for axis in positions:
            axis.aim = None

    # --- jobs: one exchange after the other

    def enabling(self, job: AwaitedJob[FeetechAxis], axis: FeetechAxis) -> Steps:
        """Switches torque on at the measured position with the joint's acceleration and speed; reads all back."""
        self.require_answering(axis)
        health = yield from self.read_health(axis)
        if health.error and health.torque:  # only a switch off and on ends an overload
            axis.ready = False
            yield from self.write_register(job, axis, table.TORQUE, 0)
            health = yield from self.read_health(axis)
        if health.error:
            raise axis.fault_error()
        yield from self.verify_settings(axis)
        if not health.locked:
            yield from self.write_register(job, axis, table.LOCK, 1)
            health = yield from self.read_health(axis)
        block = yield from self.retry(axis, lambda: self._seed(job, axis))
        yield from self.write_register(job, axis, table.TORQUE, table.TORQUE_ON)
        axis.ready = False
        health = yield from self.read_health(axis)
        kept = yield from self.retry(axis, lambda: self.wire.read(axis.id, *GOAL_BLOCK).data)
        if not health.torque or kept != block:
            raise axis.fault_error("it did not keep what enabling it wrote")
        axis.fault, axis.ready = "", True

    def relaxing(self, job: AwaitedJob[FeetechAxis], axis: FeetechAxis) -> Steps:
        axis.ready = False  # first, since a health read in between would take torque off for a fault
        yield from self.write_register(job, axis, table.TORQUE, 0)
        health = yield from self.read_health(axis)
        if health.torque:
            raise axis.fault_error("it did not relax: its torque is still on")

    def leaving(self, job: AwaitedJob[FeetechAxis], axis: FeetechAxis, *, relax: bool) -> Steps:
        """Switches torque off or leaves it on; there is no watchdog to disarm."""
        axis.ready = False
        if relax:
            yield from self.relaxing(job, axis)

    def _seed(self, job: AwaitedJob[FeetechAxis], axis: FeetechAxis) -> bytes:
        """Sets the goal to the measured position, which may switch torque on; measures again at each retry."""
        asked_ns = self.clock()
        health = axis.take_health(self.wire.read(axis.id, *axis.slow).data, asked_ns)
        goal = axis.seed(health.position)
        block = goal_block(goal)
        axis.aim, axis.sent = None, goal.position
        self.wire.write(axis.id, GOAL_BLOCK[0], block, job.gate)
        return block

    # --- from the bus thread

    def check_settings(self, axis: FeetechAxis, settings: bytes, key: str) -> None:
        """Compares the persistent registers with the robot file. Raises ``ConfigurationError``."""
        axis.unload = table.UNLOAD.decode(settings)
        phase = table.PHASE.decode(settings)
        if table.END.decode(settings) != 0:
            _wrong(key, "its words have their high byte first (register 2): it is no servo of the STS series")
        if table.STATUS_LEVEL.decode(settings) != 1:
            _wrong(key, "its status level (register 8) is 0: it answers no write; set it to 1")
        if (mode := table.MODE.decode(settings)) != table.POSITION_MODE:
            _wrong(key, f"its mode (register 33) is {mode}; set it to 0, position control, with torque off")
        if not phase & table.SPEED_IN_STEPS:
            _wrong(key, f"its phase (register 18) is {phase}: speeds are in units of 0.732 rpm; set bit 2")
        if phase & table.FULL_TURNS:
            _wrong(key, f"its phase (register 18) is {phase}: positions count whole turns; clear bit 4")
        if phase & table.DIRECTIONS:
            problem = f"its phase (register 18) is {phase}: it turns or counts in the other direction by itself, and"
            stated = f"the file has reversed = {str(axis.joint.reversed).lower()}"
            _wrong(key, f"{problem} {stated}; clear bits 0 and 7, use reversed, and calibrate")
        low, high = table.MIN_ANGLE.decode(settings), table.MAX_ANGLE.decode(settings)
        if low == high == 0:
            _wrong(key, "its range (registers 9 and 11) is 0 to 0, which is many turns; set it to 0 and 4095")
        check_own_range(axis, settings, key)

    def name_of(self, model_number: int) -> str:
        return table.name_of(model_number, str(model_number))

    def admit(self, axis: FeetechAxis) -> None:
        self.stop_found_moving(axis)

    def look_after(self, axis: FeetechAxis) -> None:
        """Switches off a servo stopped by its own protection, as it would continue once the cause is gone."""
        if axis.health is not None and axis.health.torque and axis.health.error & axis.unload:
            self.wire.write(axis.id, table.TORQUE.address, table.TORQUE.encode(0))
            axis.take_health(self.wire.read(axis.id, *axis.slow).data, self.clock())

    def watch(self) -> None:
        super().watch()
        self._lead_on()

    def _lead_on(self) -> None:
        """Sends moving joints their next goals, at most the allowed distance ahead of their measurements."""
        steps: dict[FeetechAxis, Goal] = {}
        now_ns = self.clock()
        for motion in dict.fromkeys(axis.motion for axis in self.devices if axis.motion is not None):
            try:
                if due := _due(motion, now_ns):
                    motion.permit.gate()
                    steps.update(due)
            except TradeError as ending:
                self.release(motion, ending)
        if steps:
            self._send(steps)

    def _send(self, goals: Mapping[FeetechAxis, Goal], gate: Gate | None = None) -> None:
        data = {axis.id: goal_block(goal) for axis, goal in goals.items()}
        self.wire.sync_write(GOAL_BLOCK[0], data, gate)
        sent_ns = self.clock()
        for axis, goal in goals.items():
            axis.sent, axis.sent_ns = goal.position, sent_ns


def _due(motion: AxisMotion[FeetechAxis], now_ns: int) -> dict[FeetechAxis, Goal]:
    """Returns the next goals of a motion's joints, where they differ from the last ones."""
    due: dict[FeetechAxis, Goal] = {}
    for axis in motion.devices:
        if axis.aim is None or axis.in_doubt:
            continue
        if (step := axis.step(axis.aim, now_ns)).position != axis.sent:
            due[axis] = step
    return due


def goal_block(goal: Goal) -> bytes:
    """Returns the bytes from acceleration to goal speed."""
    return b"".join(
        (
            table.ACCELERATION.encode(goal.accel),
            table.GOAL_POSITION.encode(goal.position),
            table.GOAL_TIME.encode(0),
            table.GOAL_SPEED.encode(goal.speed * table.STEPS_PER_SPEED),
        )
    )


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)
