"""The verification of drives before they join the cycle, at attach and after losses. Enables and moves nothing."""

import logging
from collections.abc import Callable, Sequence
from typing import Final

from trade.errors import ConfigurationError
from trade_drivers.bus._cycle import PROBE_NS
from trade_drivers.bus.can import frame_bits
from trade_drivers.joints import DeviceUnusable, Steps, check_joints, check_least, check_rate
from trade_drivers.joints.can import STILL_RAD_S, DifferentMotor
from trade_drivers.joints.can._cycle import MotorExchange
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import DriveAxis, Stage
from trade_drivers.vendors.cia402._table import DictionaryEntry, Pdo, State, state_of
from trade_drivers.vendors.cia402._units import check_units, read_optional
from trade_drivers.vendors.cia402._wire import Answer, DriveRefused, Net, NoAnswer
from trade_robotfile import CanBus

_log = logging.getLogger("trade")
_QUICK_STOP: Final = 3
"""Value of 6007h: quick stop after a lost heartbeat."""
_BRAKE_AND_STAY: Final = 6
"""Value of 605Ah: brake on the quick-stop ramp, and hold with torque."""
_BRAKE: Final = 1
"""Value of 605Dh: brake on the ramp of 6084h, and hold with torque."""
_LARGEST: Final = 2**31 - 1
_UNHEARD_NS: Final = 2_000_000_000
"""The wait for a drive's frames after set-up, before it is set up again."""


def check_bus(bus: CanBus, axes: Sequence[DriveAxis], where: str) -> None:
    """Checks the robot file: node numbers, counts, speeds, and whether a cycle is long enough for its frames.

    Raises:
        ConfigurationError: a check failed; names the key and the right value.
    """
    check_joints(axes, where, _check_joint)
    check_rate(bus, where, 3)
    frames = frame_bits(table.STATUS.layout.size) + frame_bits(table.TURNING.layout.size)
    slower = frame_bits(table.MOTION.layout.size) / motion_every(bus)
    cycle_s = (frame_bits(0) + len(axes) * (frames + slower)) / bus.bitrate
    if cycle_s * bus.rate_hz > 1:
        need = f"{len(axes)} drives at {bus.bitrate} bit/s need {cycle_s * 1e3:.1f} ms a cycle"
        problem = f"{need}: at most {1 / cycle_s:.0f} Hz"
        raise ConfigurationError(where=f"{where}: bus.{bus.name}.rate_hz", problem=problem)


def _check_joint(axis: DriveAxis) -> None:
    joint = axis.joint
    if joint.counts_per_rev is None:
        raise DeviceUnusable(
            "missing; a CiA 402 drive's angles are counts: write counts_per_rev = 4096, or as many", ""
        )
    if joint.homing_counts:
        raise DeviceUnusable("is for servos; leave this key out", ".homing_counts")
    if not 1 <= joint.id < table.OUR_NODE:
        raise DeviceUnusable(f"{joint.id} is no node of a drive; 1 to 126 are (127 is the driver's own)", ".id")
    if max(abs(axis.low), abs(axis.high)) > _LARGEST:
        raise DeviceUnusable("the range does not fit into 32 bits of counts; check counts_per_rev and gear", ".max_rad")
    check_least(axis, "one count of its encoder")


def motion_every(bus: CanBus) -> int:
    """Returns the number of SYNCs per second TPDO of a drive."""
    return max(1, min(240, round(bus.rate_hz / 100)))


def set_up(net: Net, axis: DriveAxis, bus: CanBus) -> Steps:
    """Checks a drive's identity, arms its watchdog and maps its frames; stops a motion that no client owns.

    Makes about seventy requests, one at a time; yields while it waits for answers.

    Raises:
        Unfit: the drive cannot be used.
        NoAnswer: the drive does not answer.
    """
    yield from _check_identity(net, axis)
    yield from check_units(net, axis)
    yield from _check_abilities(net, axis)
    yield from _halt_if_moving(net, axis)
    try:
        yield from _arm(net, axis, bus)
        yield from _map_first(net, axis)
        yield from _map(net, axis.id, table.MOTION, motion_every(bus), table.NO_REMOTE)
        for pdo in (table.COMMAND, table.PROFILE):
            yield from _map(net, axis.id, pdo, table.AT_EVENT, 0)
        yield from _map_streams(net, axis, bus)
    except DriveRefused as refused:
        raise DeviceUnusable(f"it refuses to be set up: {refused}") from None
    for record in table.UNUSED:
        yield from _try_write(net, axis.id, DictionaryEntry(record, "u4", 1), _disabled(record, axis.id))
    net.command(axis.id, table.NMT_START)
    axis.operational = True


def _check_identity(net: Net, axis: DriveAxis) -> Steps:
    kind = (yield from net.read(axis.id, table.DEVICE_TYPE)) & 0xFFFF
    if kind != table.DRIVE_PROFILE:
        raise DeviceUnusable(f"node {axis.id} is no CiA 402 drive: its device type (1000h) names profile {kind}")
    identity: tuple[int, ...] = ()
    for entry in table.IDENTITY:
        identity += ((yield from _read(net, axis.id, entry)),)
    if axis.identity and identity != axis.identity:
        raise DeviceUnusable(
            f"another drive answers as node {axis.id}: {_name_of(identity)}, not {_name_of(axis.identity)}"
        )
    try:
        name = yield from net.read_text(axis.id, table.DEVICE_NAME)
    except DriveRefused:
        name = axis.joint.model  # it reports none, which is allowed
    if name != axis.joint.model:
        raise DeviceUnusable(f"is {axis.joint.model!r}, but node {axis.id} says it is {name!r} (1008h)", ".model")
    yield from _check_fingerprint(net, axis, identity)
    axis.identity = identity


def _check_fingerprint(net: Net, axis: DriveAxis, identity: Sequence[int]) -> Steps:
    """Checks the serial number and firmware, as far as the robot file has them."""
    joint, (_, _, _, serial_number) = axis.joint, identity
    if joint.serial_number is not None and serial_number != joint.serial_number:
        raise DifferentMotor("serial_number", str(joint.serial_number), str(serial_number), "drive")
    if joint.firmware is None:
        return
    try:
        firmware = yield from net.read_text(axis.id, table.SOFTWARE_VERSION)
    except DriveRefused:
        raise DeviceUnusable("it reports no firmware version (100Ah); leave this key out", ".firmware") from None
    if firmware != joint.firmware:
        raise DifferentMotor("firmware", joint.firmware, firmware, "drive")


def _name_of(identity: Sequence[int]) -> str:
    vendor, product, _, serial = identity
    return f"vendor {vendor:X}h, product {product:X}h, serial number {serial}"


def _check_abilities(net: Net, axis: DriveAxis) -> Steps:
    modes = yield from _read(net, axis.id, table.SUPPORTED_MODES, 1 << table.PROFILE_POSITION - 1)
    axis.modes = frozenset(mode for mode in range(1, 33) if modes >> mode - 1 & 1)
    if table.PROFILE_POSITION not in axis.modes:
        raise DeviceUnusable("it has no profile position mode (6502h)")
    low = yield from _read(net, axis.id, table.POSITION_LIMITS[0])
    high = yield from _read(net, axis.id, table.POSITION_LIMITS[1])
    if low > high or low == high != 0:
        raise DeviceUnusable(
            f"its own range is impossible: 607Dh = {low} to {high}; set it to what is true, or both to 0"
        )
    axis.own_range = (low, high) if low < high else None
    if low < high and (axis.low < low or axis.high > high):
        ends = sorted((axis.scale.angle_rad(low), axis.scale.angle_rad(high)))
        joint = axis.joint
        raise DeviceUnusable(
            f"min_rad {joint.min_rad:.6g} to max_rad {joint.max_rad:.6g} is more than the drive's own range (607Dh), "
            f"{ends[0]:.6g} to {ends[1]:.6g} rad; narrow the one or widen the other"
        )
    fastest = yield from _read(net, axis.id, table.MAX_PROFILE_VELOCITY)
    if 0 < fastest < axis.speed_counts:
        limit = fastest * axis.resolution.rad_s
        problem = f"{axis.joint.max_speed_rad_s:.6g} is above the drive's own limit {limit:.4g} (607Fh)"
        raise DeviceUnusable(problem, ".max_speed_rad_s")


def _halt_if_moving(net: Net, axis: DriveAxis) -> Steps:
    """Stops a motion that no client owns; leaves torque as it is."""
    state = state_of((yield from net.read(axis.id, table.STATUSWORD)))
    if state is not State.ENABLED:
        return
    if abs((yield from net.read(axis.id, table.VELOCITY))) * axis.resolution.rad_s <= STILL_RAD_S:
        return
    if (yield from net.read(axis.id, table.MODE_DISPLAY)) < table.CYCLIC_POSITION:
        yield from net.write(axis.id, table.CONTROLWORD, table.HOLD)
        return
    yield from _try_write(net, axis.id, table.QUICK_STOP_OPTION, _BRAKE_AND_STAY)
    yield from net.write(axis.id, table.CONTROLWORD, table.QUICK_STOP)


def _arm(net: Net, axis: DriveAxis, bus: CanBus) -> Steps:
    for entry, value in (
        (table.ABORT_CONNECTION, _QUICK_STOP),
        (table.CONSUMER_HEARTBEAT, table.OUR_NODE << 16 | round(bus.watchdog_s * 1e3)),
        (table.PRODUCER_HEARTBEAT, heartbeat_ms(bus)),
    ):
        yield from net.write(axis.id, entry, value)
    for entry, value in ((table.QUICK_STOP_OPTION, _BRAKE_AND_STAY), (table.HALT_OPTION, _BRAKE)):
        yield from _try_write(net, axis.id, entry, value)
    yield from _try_write(net, axis.id, table.QUICK_STOP_DECELERATION, axis.accel_counts)


def _map_first(net: Net, axis: DriveAxis) -> Steps:
    """Maps the first PDO; an operational drive becomes pre-operational, as many refuse or ignore a new mapping before.

    Torque stays as it is. A drive whose state is unknown is asked first, as attaching commands nothing needlessly.
    """
    if axis.operational:
        net.command(axis.id, table.NMT_PREOPERATIONAL)
    try:
        yield from _map(net, axis.id, table.STATUS, 1, table.NO_REMOTE)
    except DriveRefused as refused:
        if refused.code != table.NOT_IN_THIS_STATE:
            raise
        net.command(axis.id, table.NMT_PREOPERATIONAL)
        yield from _map(net, axis.id, table.STATUS, 1, table.NO_REMOTE)


def _map_streams(net: Net, axis: DriveAxis, bus: CanBus) -> Steps:
    """Sets up the optional modes without a goal; a drive that lacks something for them is used without them."""
    if (yield from _read(net, axis.id, table.QUICK_STOP_OPTION)) not in table.STANDING:
        axis.modes -= {table.PROFILE_VELOCITY_MODE, table.CYCLIC_VELOCITY, table.CYCLIC_POSITION}
    if axis.turning_mode != table.PROFILE_POSITION:
        try:
            yield from _map(net, axis.id, table.TURNING, table.AT_EVENT, 0)
        except DriveRefused:
            axis.modes -= {table.PROFILE_VELOCITY_MODE, table.CYCLIC_VELOCITY}
    if axis.turning_mode == table.PROFILE_POSITION:
        yield from _map(net, axis.id, table.BRAKING, table.AT_EVENT, 0)
    if table.CYCLIC_POSITION in axis.modes:
        try:
            for entry, value in zip(table.INTERPOLATION_PERIOD, interpolation_period(bus.rate_hz), strict=True):
                yield from net.write(axis.id, entry, value)
            yield from _map(net, axis.id, table.FOLLOWING, table.AT_NEXT_SYNC, 0)
        except DriveRefused:
            axis.modes -= {table.CYCLIC_POSITION}
    if table.CYCLIC_POSITION not in axis.modes:
        record = table.FOLLOWING.communication
        yield from _try_write(net, axis.id, DictionaryEntry(record, "u4", 1), _disabled(record, axis.id))


def heartbeat_ms(bus: CanBus) -> int:
    """Returns a drive's heartbeat interval: a third of the allowed time."""
    return max(10, round(bus.stale_after_s * 1e3 / 3))


def _map(net: Net, node: int, pdo: Pdo, kind: int, flags: int) -> Steps:
    """Maps a PDO in the order that drives require: invalid, empty, filled, counted, valid."""
    record, mapping, cob = pdo.communication, pdo.communication + 0x200, pdo.base + node | flags
    yield from net.write(node, DictionaryEntry(record, "u4", 1), cob | table.INVALID)
    yield from net.write(node, DictionaryEntry(record, "u1", 2), kind)
    yield from net.write(node, DictionaryEntry(mapping, "u1", 0), 0)
    for place, word in enumerate(pdo.mapping(), 1):
        yield from net.write(node, DictionaryEntry(mapping, "u4", place), word)
    yield from net.write(node, DictionaryEntry(mapping, "u1", 0), len(pdo.entries))
    yield from net.write(node, DictionaryEntry(record, "u4", 1), cob)


def _disabled(record: int, node: int) -> int:
    base = {0x1403: 0x500, 0x1802: 0x380, 0x1803: 0x480}[record]
    return table.INVALID | (base + node)


def _read(net: Net, node: int, entry: DictionaryEntry, default: int = 0) -> Answer[int]:
    """Reads an optional object."""
    value = yield from read_optional(net, node, entry)
    return default if value is None else value


def _try_write(net: Net, node: int, entry: DictionaryEntry, value: int) -> Steps:
    """Writes an optional object; the drive's own value is acceptable, too."""
    try:
        yield from net.write(node, entry, value)
    except DriveRefused:
        return


def interpolation_period(rate_hz: float) -> tuple[int, int]:
    """Returns a period for object 60C2h: a number below 256, and a power of ten in s."""
    for exponent in (-3, -4, -5, -6):  # all drives accept whole milliseconds
        count = 10.0**-exponent / rate_hz
        if abs(count - round(count)) < 1e-3 and round(count) < 256:
            return round(count), exponent
    exponent = next(exponent for exponent in (-5, -4, -3, -2, -1, 0) if 10.0**-exponent / rate_hz < 255)
    return round(10.0**-exponent / rate_hz), exponent


class Admission:
    """The admission of one drive. It enables nothing and moves nothing.

    | stage       | what happens                           | and then                                              |
    |-------------|----------------------------------------|-------------------------------------------------------|
    | AWAY        | nothing, until its turn comes          | VERIFYING                                             |
    | VERIFYING   | one request after the other            | SET_UP; AWAY for a while, if it is silent or unfit    |
    | SET_UP      | its heartbeat and measurements awaited | HERE; AWAY, with that as its fault, if they stay away |
    | HERE        | it is measured in every cycle          |                                                       |

    Each stage changes to AWAY when the drive restarts, or when the drive or the port is gone.
    """

    def __init__(
        self,
        exchange: MotorExchange[DriveAxis],
        net: Net,
        axis: DriveAxis,
        bus: CanBus,
        beat_next: Callable[[], None],
    ) -> None:
        self.axis = axis
        self._exchange, self._net, self._bus, self._beat_next = exchange, net, bus, beat_next
        self._recall_at_ns = 0
        self._steps = set_up(net, axis, bus)

    def advance(self) -> None:
        """Advances as far as possible without waiting."""
        match self.axis.stage:
            case Stage.AWAY:
                self._begin()
            case Stage.VERIFYING:
                self._verify()
            case Stage.SET_UP:
                self._await()
            case Stage.HERE:
                pass

    def recall(self) -> None:
        """Restarts a drive that network management has stopped; repeats, since the command has no confirmation."""
        axis, now_ns = self.axis, self._exchange.clock()
        if axis.stopped and now_ns >= self._recall_at_ns:
            _log.warning("%s: network management has stopped it; it is put to pre-operational and set up", axis.name)
            self._net.command(axis.id, table.NMT_PREOPERATIONAL)
            self._recall_at_ns, axis.probe_at_ns = now_ns + PROBE_NS, now_ns

    def _begin(self) -> None:
        axis, exchange = self.axis, self._exchange
        busy = exchange.worked_on(axis) and not axis.recalled  # a drive answers only one of two requests
        if exchange.clock() >= axis.probe_at_ns and not busy:
            axis.stage, self._steps = Stage.VERIFYING, set_up(self._net, axis, self._bus)
            self._verify()

    def _verify(self) -> None:
        try:
            next(self._steps)
        except StopIteration:
            self.axis.await_frames(self._exchange.clock())
            self._beat_next()
        except NoAnswer as silent:
            self.axis.unfit = ""
            self._try_later(silent)
        except (DeviceUnusable, DriveRefused) as unfit:
            self.axis.fault = self.axis.unfit = str(unfit)  # replaces an earlier fault, as this must be fixed first
            self._try_later(unfit)

    def _await(self) -> None:
        axis, now_ns = self.axis, self._exchange.clock()
        if axis.to_start:
            axis.to_start = False
            self._net.command(axis.id, table.NMT_START)
        if not axis.unheard:
            _log.info("%s answers on %s", axis.name, axis.bus)
            axis.welcome(now_ns)
        elif now_ns - axis.set_up_ns > max(_UNHEARD_NS, 2 * self._exchange.silent_after_ns):
            problem = DeviceUnusable(
                f"node {axis.id} answers, but sends {axis.unheard}; a drive without it cannot be used"
            )
            self._exchange.problems[axis] = problem
            axis.fault, axis.ready = str(problem), False
            axis.forget(now_ns)

    def _try_later(self, problem: Exception) -> None:
        self._exchange.problems[self.axis] = problem
        now_ns = self._exchange.clock()
        self.axis.forget(now_ns)
        self.axis.probe_at_ns = now_ns + PROBE_NS
