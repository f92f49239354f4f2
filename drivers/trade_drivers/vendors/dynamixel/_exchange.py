"""The exchange with a bus of Dynamixel servos: commands in each cycle, and the steps of enabling and relaxing."""

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NoReturn

from trade.errors import ConfigurationError
from trade_drivers.joints import AwaitedJob, Gate, Goal, Steps
from trade_drivers.joints.serial import NoAnswer, ServoExchange, check_own_range
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import CYCLIC, DynamixelAxis, DynamixelHealth
from trade_robotfile import SerialBus

if TYPE_CHECKING:
    from trade_drivers.vendors.dynamixel._wire import Wire

_SIZES: Final = tuple(
    register.end - CYCLIC[0]
    for register in (table.PRESENT_POSITION, table.VELOCITY_TRAJECTORY, table.POSITION_TRAJECTORY)
)
_BOOT_NS: Final = 2_000_000_000
"""The time allowed for a servo to restart and to be accepted again."""
_WAIT_S: Final = 0.001
_GOAL_BLOCK: Final = (
    table.PROFILE_ACCELERATION.address,
    table.GOAL_POSITION.end - table.PROFILE_ACCELERATION.address,
)
_OTHER_THAN_REVERSED: Final = 0xFE
_SHADOWS: Final = 252
_ALL_ANSWER: Final = 2


class DynamixelExchange(ServoExchange[DynamixelAxis, "Wire"]):
    """The exchange with the Dynamixel servos of one bus."""

    sizes = _SIZES
    answer_overhead = 12

    def __init__(
        self,
        wire: "Wire",
        bus: SerialBus,
        axes: Sequence[DynamixelAxis],
        clock: Callable[[], int] | None = None,
    ) -> None:
        super().__init__(wire, bus, axes, clock)
        self.watchdog_counts = max(1, min(127, round(bus.watchdog_s / table.BUS_WATCHDOG.si_per_count)))

    # --- commands

    def write_goals(self, goals: Mapping[DynamixelAxis, Goal], gate: Gate) -> None:
        data = {axis.id: _goal_block(goal) for axis, goal in goals.items()}
        self.wire.sync_write(table.PROFILE_ACCELERATION.address, data, gate)

    def write_positions(self, positions: Mapping[DynamixelAxis, int], gate: Gate) -> None:
        data = {axis.id: table.GOAL_POSITION.encode(position) for axis, position in positions.items()}
        self.wire.sync_write(table.GOAL_POSITION.address, data, gate)

    def write_holds(self, positions: Mapping[DynamixelAxis, int]) -> None:
        ready: dict[int, bytes] = {}
        others: dict[int, bytes] = {}
        for axis, position in positions.items():
            if axis.ready or axis.outside(position):
                ready[axis.id] = _goal_block(axis.brake(position))
            else:
                others[axis.id] = table.GOAL_POSITION.encode(axis.own_goal(position))
        if ready:
            self.wire.sync_write(table.PROFILE_ACCELERATION.address, ready)
        if others:
            self.wire.sync_write(table.GOAL_POSITION.address, others)

    # --- jobs: one exchange after the other

    def enabling(self, job: AwaitedJob[DynamixelAxis], axis: DynamixelAxis) -> Steps:
        """Switches torque on at the measured position with the joint's profile and an armed watchdog; all read back."""
        self.require_answering(axis)
        health = yield from self.read_health(axis)
        if health.error and health.torque:
            raise axis.fault_error(f"{axis.fault}, and it has not let go: call relax() before enable()")
        if health.error:
            health = yield from self._restart(job, axis)
        if health.error:
            raise axis.fault_error()
        yield from self.verify_settings(axis)
        if health.watchdog:
            yield from self.write_register(job, axis, table.BUS_WATCHDOG, 0)
        block = yield from self.retry(axis, lambda: self._seed(job, axis))
        armed = self.watchdog_counts
        yield from self.write_register(job, axis, table.BUS_WATCHDOG, armed)
        yield from self.write_register(job, axis, table.TORQUE_ENABLE, 1)
        axis.ready = False
        health = yield from self.read_health(axis)
        kept = yield from self.retry(axis, lambda: self.wire.read(axis.id, *_GOAL_BLOCK).data)
        if not health.torque or health.watchdog != armed or kept != block:
            raise axis.fault_error("it did not keep what enabling it wrote")
        axis.fault, axis.ready = "", True

    def relaxing(self, job: AwaitedJob[DynamixelAxis], axis: DynamixelAxis) -> Steps:
        axis.ready = False  # first, since a health read in between would take torque off for a fault
        yield from self.write_register(job, axis, table.TORQUE_ENABLE, 0)
        yield from self.write_register(job, axis, table.BUS_WATCHDOG, 0)
        health = yield from self.read_health(axis)
        if health.torque:
            raise axis.fault_error("it did not relax: its torque is still on")

    def leaving(self, job: AwaitedJob[DynamixelAxis], axis: DynamixelAxis, *, relax: bool) -> Steps:
        health = yield from self.read_health(axis)
        if relax and health.torque:
            axis.ready = False
            yield from self.write_register(job, axis, table.TORQUE_ENABLE, 0)
        elif health.watchdog == table.WATCHDOG_EXPIRED or axis.still == 0:
            return
        if health.watchdog:
            yield from self.write_register(job, axis, table.BUS_WATCHDOG, 0)
        axis.ready = False

    def _seed(self, job: AwaitedJob[DynamixelAxis], axis: DynamixelAxis) -> bytes:
        """Sets the goal to the measured position; measures again at each retry, as the joint may have sagged."""
        register = table.PRESENT_POSITION
        answer = self.wire.read(axis.id, register.address, register.size)
        position = register.decode(answer.data, register.address)
        block = _goal_block(axis.seed(position))
        self.wire.write(axis.id, _GOAL_BLOCK[0], block, job.gate)
        return block

    def _restart(self, job: AwaitedJob[DynamixelAxis], axis: DynamixelAxis) -> Generator[None, None, DynamixelHealth]:
        """Restarts a servo that has shut down, and returns its health; only that or a power cycle ends a shutdown."""
        axis.ready = False
        began_ns = self.clock()
        with suppress(NoAnswer):  # its next answer shows whether it restarted
            self.wire.reboot(axis.id, job.gate)
        while True:
            self.idle(_WAIT_S)
            yield
            now_ns, health = self.clock(), axis.health
            heard = None if axis.silent or axis.doubted or health is None or health.at_ns <= began_ns else health
            if heard is not None and (not heard.error or now_ns - began_ns > _BOOT_NS):
                return heard
            if now_ns - began_ns > 2 * _BOOT_NS:
                raise axis.silent_error(now_ns)

    # --- from the bus thread

    def name_of(self, model_number: int) -> str:
        return table.name_of(model_number, str(model_number))

    def admit(self, axis: DynamixelAxis) -> None:
        """Arms the watchdog of a joint that is already enabled, and stops one that moves."""
        health = axis.health
        if health is None or not health.torque or health.watchdog == table.WATCHDOG_EXPIRED:
            return
        self.wire.write(axis.id, table.BUS_WATCHDOG.address, table.BUS_WATCHDOG.encode(self.watchdog_counts))
        self.stop_found_moving(axis)

    def check_settings(self, axis: DynamixelAxis, settings: bytes, key: str) -> None:
        """Compares the persistent registers with the robot file. Raises ``ConfigurationError``."""
        joint, health = axis.joint, axis.health
        mode, drive = table.OPERATING_MODE.decode(settings), table.DRIVE_MODE.decode(settings)
        if health is not None and health.status_level != _ALL_ANSWER:
            _wrong(key, f"its status return level (register 68) is {health.status_level}; set it to 2")
        if mode != table.POSITION_MODE:
            _wrong(key, f"its operating mode (register 11) is {mode}; set it to 3, position control, with torque off")
        if drive & _OTHER_THAN_REVERSED:
            problem = f"its drive mode (register 10) is {drive}; set it to 0, with torque off: speeds as velocities"
            _wrong(key, f"{problem}, torque switched on by nothing but us")
        if drive:
            problem = f"its drive mode (register 10) is {drive}: it counts in the other direction by itself, and the"
            stated = f"file has reversed = {str(joint.reversed).lower()}"
            _wrong(key, f"{problem} {stated}; set it to 0, use reversed, and calibrate")
        if (shadow := table.SHADOW_ID.decode(settings)) <= _SHADOWS:
            _wrong(key, f"it also obeys what is sent to id {shadow} (register 12); set it to 255, with torque off")
        check_own_range(axis, settings, key)
        fastest = table.VELOCITY_LIMIT.decode(settings)
        if axis.speed_counts > fastest:
            limit = fastest * table.RAD_S_PER_COUNT
            _wrong(
                f"{key}.max_speed_rad_s",
                f"{joint.max_speed_rad_s:.6g} is above the device's own limit {limit:.4g} (register 44)",
            )


def _goal_block(goal: Goal) -> bytes:
    """Returns the bytes from profile acceleration to goal position."""
    return b"".join(
        (
            table.PROFILE_ACCELERATION.encode(goal.accel),
            table.PROFILE_VELOCITY.encode(goal.speed),
            table.GOAL_POSITION.encode(goal.position),
        )
    )


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)
