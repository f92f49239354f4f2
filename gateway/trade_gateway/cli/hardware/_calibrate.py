"""``trade calibrate ROBOT.toml JOINT``: measures zero and range of a joint that a person moves, or imports them."""

import difflib
import os
import select
import stat
import sys
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from math import pi, remainder, tau
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeVar, cast

import typer
from msgspec import Struct
from rich.markup import escape

from trade.atomic_files import replace
from trade.errors import ConfigurationError, WrongDevice
from trade.text_files import as_before, as_text
from trade_drivers import Bench, Driver, Joint, Robot, SerialBus, WireError, load, load_driver, parse
from trade_gateway._usage import UsageError
from trade_gateway.cli.hardware._lerobot import imported, read_calibration
from trade_gateway.terminal._output import Output

if TYPE_CHECKING:
    import tomlkit

_MARGIN_RAD: Final = 0.02
"""How far inside the measured ends the range lies: a mechanical stop yields a little."""
_LEAST_RAD: Final = 0.1
_APART_S: Final = 0.3
_STILL_RAD: Final = 0.01
"""The most that a joint held still by hand moves between two readings."""
_LONGEST_S: Final = 600.0
"""How long a person may take between two prompts, in seconds."""
_DIGITS: Final = 4
_PATIENCE_S: Final = 2.0
"""How long to retry a device that does not answer, so that a loose plug does not lose the measurement."""
_COUNTS: Final = 4096
_MOST_HOMING: Final = 2047
"""The largest homing offset of a Feetech servo, in counts (memory table, register 31)."""
_AGAIN_S: Final = 0.02

_Number = TypeVar("_Number", int, float)


def calibrate(
    robot_file: Annotated[Path, typer.Argument(metavar="ROBOT.toml", help="The robot file.")],
    joint: Annotated[
        str | None, typer.Argument(help="Name of the joint in the file: neck.pan. With --from, by default all.")
    ] = None,
    zero_here: Annotated[bool, typer.Option("--zero-here", help="Use the current position as zero.")] = False,
    range_from_motion: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=1.0, max=_LONGEST_S, help="Time to move it over its range, in seconds."),
    ] = None,
    from_file: Annotated[
        Path | None, typer.Option("--from", metavar="ARM.json", help="Import this calibration of LeRobot instead.")
    ] = None,
    bus: Annotated[str | None, typer.Option(help="With --from: bus of the arm, if several have its ids.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Write the file without a prompt.")] = False,
) -> None:
    """Measure zero and range of a joint that you move by hand, or import them.

    Both are written into the robot file, whose comments are kept.
    The joint's torque must be off. Nothing is written to the device.
    --from imports homing offsets and ranges that LeRobot has measured and set, and opens no port.

    For example: trade calibrate rosie.toml neck.pan
    """
    out = Output(as_json=False)
    robot = load(robot_file)
    before = robot_file.read_bytes()
    if from_file is not None:
        if zero_here or range_from_motion is not None:
            raise UsageError(where="--from", problem="imports zero and range, and measures none; leave the others out")
        _import(out, robot, robot_file, before, from_file, joint, bus, yes=yes)
        return
    if joint is None:
        raise UsageError(where="JOINT", problem="missing; name the joint to measure")
    if bus is not None:
        raise UsageError(where="--bus", problem="needs --from")
    record, line = _joint(robot, joint)
    with _slack(line, record) as bench:
        sweep = Sweep(bench, record.id, _place(line, record))
        values = _measure(out, record, sweep, zero_here=zero_here, seconds=range_from_motion)
        values |= homed(record, sweep.homing_counts(), zero_measured="offset_rad" in values)
    changed = with_values(as_text(before), joint, values)
    parse(changed, str(robot_file))
    _write(out, robot_file, before, changed, yes=yes)


def _import(
    out: Output, robot: Robot, path: Path, before: bytes, source: Path, joint: str | None, bus: str | None, *, yes: bool
) -> None:
    """Writes a calibration of LeRobot into the robot file."""
    if joint is not None:
        _joint(robot, joint)
    values, remarks = imported(robot, read_calibration(source), str(source), joint, bus)
    changed = as_text(before)
    for name, keys in values.items():
        changed = with_values(changed, name, keys)
    parse(changed, str(path))
    for remark in remarks:
        out.say(escape(remark))
    _write(out, path, before, changed, yes=yes)


class TravelEnds(Struct, frozen=True):
    """The ends that a device was moved to, in its own direction.

    A device that passes the end of its encoder counts further here: ``low`` or ``high`` is then beyond half a turn.
    """

    low: float
    high: float
    last: float
    """Its last reading."""


class Sweep:
    """Readings of one device while it is moved by hand.

    Args:
        bench: the device's line.
        device_id: its id on the line.
        where: the joint and its port, for messages.
        patience_s: how long to retry if it does not answer.
    """

    def __init__(self, bench: Bench, device_id: int, where: str, patience_s: float = _PATIENCE_S) -> None:
        self._bench, self._id, self._where, self._patience_s = bench, device_id, where, patience_s

    def until(self, done: Callable[[], bool], longest_s: float) -> TravelEnds:
        """Reads positions until a condition holds.

        Raises:
            ConfigurationError: it turned by more than a turn, or the condition did not hold in time.
        """
        low = high = at = last = self.read()
        until = time.monotonic() + longest_s
        while not done():
            if time.monotonic() > until:
                problem = f"no answer to the prompt for {longest_s:g} s; nothing was written"
                raise ConfigurationError(where=self._where, problem=problem)
            last = self.read()
            at = last + tau * round((at - last) / tau)  # 4095 to 0 is one count, not a turn
            low, high = min(low, at), max(high, at)
            if high - low >= tau:
                problem = (
                    "it turns by more than a whole turn, which one robot joint here cannot; move it between its ends"
                )
                raise ConfigurationError(where=self._where, problem=problem)
        return TravelEnds(low, high, last)

    def still(self) -> float:
        """Returns the position of a device that is held still, from two readings.

        Raises:
            ConfigurationError: the device moves.
        """
        before = self.read()
        time.sleep(_APART_S)
        now = self.read()
        if abs(now - before) > _STILL_RAD:
            problem = f"it moves (by {abs(now - before):.3f} rad in {_APART_S:g} s); hold it still, then try again"
            raise ConfigurationError(where=self._where, problem=problem)
        return now

    def read(self) -> float:
        """Returns the position from the device's own centre, in rad."""
        return self._retried(self._bench.angle_rad)

    def homing_counts(self) -> int:
        """Returns the device's own homing offset, in counts."""
        return self._retried(self._bench.homing_counts)

    def _retried(self, ask: Callable[[int], _Number]) -> _Number:
        until = time.monotonic() + self._patience_s
        while True:
            try:
                return ask(self._id)
            except WireError as bad:
                trouble = str(bad).removeprefix(f"id {self._id} ")
            if time.monotonic() > until:
                problem = f"{trouble}, asked for {self._patience_s:g} s; check its cable. Nothing was written"
                raise ConfigurationError(where=self._where, problem=problem)
            time.sleep(_AGAIN_S)


def measured(joint: Joint, zero: float | None, ends: TravelEnds | None) -> dict[str, float]:
    """Returns the values of a joint's keys that change.

    Args:
        joint: the joint in the file.
        zero: the device's angle at the joint's zero; None keeps the zero.
        ends: the ends that the device was moved to; None keeps the range.

    Raises:
        ConfigurationError: the joint was moved too little for a range, or past the end of its encoder.
    """
    sign = -1 if joint.reversed else 1
    offset = joint.offset_rad if zero is None else -sign * zero
    values = {} if zero is None else {"offset_rad": offset}
    if ends is not None:
        if ends.high - ends.low < _LEAST_RAD:
            problem = f"was moved by {ends.high - ends.low:.3f} rad only; move it from one end to the other"
            raise ConfigurationError(where=joint.name, problem=problem)
        if ends.low < -pi or ends.high > pi:
            raise ConfigurationError(where=joint.name, problem=_across(joint, ends))
        low, high = sorted((offset + sign * ends.low, offset + sign * ends.high))
        values |= {"min_rad": low + _MARGIN_RAD, "max_rad": high - _MARGIN_RAD}
    return {key: round(value, _DIGITS) + 0.0 for key, value in values.items()}


def _across(joint: Joint, ends: TravelEnds) -> str:
    """Says how to bring the middle of a range to the centre of the encoder.

    The offset of a Feetech servo moves the end of its encoder; that of a Dynamixel does not.
    """
    middle = remainder((ends.low + ends.high) / 2, tau)
    offset = (joint.homing_counts + round(middle / tau * _COUNTS) + _MOST_HOMING) % _COUNTS - _MOST_HOMING
    offset = min(offset, _MOST_HOMING)
    return (
        f"its range is {ends.high - ends.low:.3f} rad wide, but passes the end of its encoder, which a servo "
        f"cannot do. On a Feetech servo, write {offset} to its homing offset (register 31) with the vendor's tool, and "
        f"homing_counts = {offset} into the file: then its middle is the centre. On another servo, mount its horn "
        f"{abs(middle):.2f} rad further. Then measure its zero and range again"
    )


def homed(joint: Joint, found: int, *, zero_measured: bool) -> dict[str, float]:
    """Returns the key that changes if the servo's own homing offset differs from the file.

    Raises:
        WrongDevice: the servo's zero has moved, and was not measured.
    """
    if found == joint.homing_counts:
        return {}
    if not zero_measured:
        where, expected = f'joint."{joint.name}"', str(joint.homing_counts)
        raise WrongDevice(where=where, key="homing_counts", expected=expected, found=str(found))
    return {"homing_counts": found}


def with_values(text: str, joint: str, values: Mapping[str, float]) -> str:
    """Returns the text of a robot file with new values for some keys of a joint; all else is unchanged."""
    import tomlkit  # noqa: PLC0415 - slow, and only needed here

    for key in values:
        text = _with_key(text, joint, key)
    document = tomlkit.parse(text)
    table = _table(document, joint)
    for key, value in values.items():
        table[key] = value
    return tomlkit.dumps(document)  # pyright: ignore[reportUnknownMemberType]


def _with_key(text: str, joint: str, key: str) -> str:
    """Returns the text with a line for a joint's missing key, above its ``min_rad``."""
    import tomlkit  # noqa: PLC0415 - slow, and only needed here

    document = tomlkit.parse(text)
    table = _table(document, joint)
    if key in table:
        return text
    lowest, mark = table["min_rad"], "the joint that is calibrated"
    table["min_rad"] = mark
    lines = tomlkit.dumps(document).splitlines(keepends=True)  # pyright: ignore[reportUnknownMemberType]
    at = next(number for number, line in enumerate(lines) if mark in line)
    lines[at] = lines[at].replace(f'"{mark}"', repr(lowest))
    indent = lines[at][: len(lines[at]) - len(lines[at].lstrip())]
    more = "".join([*lines[:at], f"{indent}{key} = 0.0\n", *lines[at:]])
    if key not in _table(tomlkit.parse(more), joint):
        raise ConfigurationError(where=f'joint."{joint}"', problem=f"write {key} = 0.0 into its table, then try again")
    return more


def _table(document: "tomlkit.TOMLDocument", joint: str) -> dict[str, object]:
    return cast("dict[str, dict[str, object]]", document["joint"])[joint]


def _joint(robot: Robot, name: str) -> tuple[Joint, SerialBus]:
    """Returns a joint whose servo can be turned by hand, and its bus."""
    joint = next((one for one in robot.joints if one.name == name), None)
    if any(one.name == name for one in robot.grippers):
        activate = f"`trade call {robot.name}.{name}.activate`, once it is up"
        raise UsageError(where=robot.where, problem=f"a gripper is not calibrated; activate it: {activate}")
    if joint is None:
        there = ", ".join(one.name for one in robot.joints) or "none"
        raise UsageError(where=robot.where, problem=f"there is no joint {name!r}; there is {there}")
    bus = next(one for one in robot.buses if one.name == joint.bus)
    if not isinstance(bus, SerialBus):
        problem = "is no servo on a serial line; its own homing finds its zero"
        raise ConfigurationError(where=f'{robot.where}: joint."{name}"', problem=problem)
    return joint, bus


def _place(bus: SerialBus, joint: Joint) -> str:
    return f"{joint.name} (id {joint.id} on {bus.port})"


@contextmanager
def _slack(bus: SerialBus, joint: Joint) -> Generator[Bench, None, None]:
    """Opens the line of a joint whose torque is off."""
    commissioner = load_driver(bus.driver, f"bus.{bus.name}.driver", Driver).commissioner
    if commissioner is None:
        raise ConfigurationError(where=joint.name, problem=f"driver {bus.driver} has nothing to calibrate by hand")
    with commissioner().at(bus.port, bus.baud) as bench:
        found = bench.alone(joint.id, _place(bus, joint))
        if found.model != joint.model:
            raise WrongDevice(where=f'joint."{joint.name}"', key="model", expected=joint.model, found=found.model)
        yield bench


def _measure(
    out: Output,
    joint: Joint,
    sweep: Sweep,
    *,
    zero_here: bool,
    seconds: float | None,
    enter: Callable[[], bool] | None = None,
) -> dict[str, float]:
    """Measures the values that the options ask for; prompts if there are no options."""
    name, asked = escape(joint.name), enter or _enter_pressed
    zero, ends = sweep.still() if zero_here else None, None
    if seconds is not None:
        out.say(f"Move [bold]{name}[/] slowly from one end to the other and back, for {seconds:g} s")
        until = time.monotonic() + seconds
        ends = sweep.until(lambda: time.monotonic() > until, seconds + 1)
    elif not zero_here:
        out.say(f"Move [bold]{name}[/] to its zero by hand, hold it there, and press Enter")
        zero = sweep.until(asked, _LONGEST_S).last
        out.say(f"Now move [bold]{name}[/] slowly from one end to the other, and press Enter")
        ends = sweep.until(asked, _LONGEST_S)
    if zero is not None and ends is None:
        out.say("the range keeps its values, relative to the new zero")
    return measured(joint, zero, ends)


def _enter_pressed() -> bool:
    """Whether a line has arrived on standard input; does not wait.

    Raises:
        UsageError: standard input is closed.
    """
    fd = sys.stdin.fileno()
    while select.select([fd], [], [], 0)[0]:
        match os.read(fd, 1):
            case b"":
                problem = "standard input is closed; --zero-here and --range-from-motion need no prompt"
                raise UsageError(where="trade calibrate", problem=problem)
            case b"\n":
                return True
            case _:
                pass
    return False


def _write(out: Output, path: Path, contents: bytes, after: str, *, yes: bool) -> None:
    """Shows the changes, prompts, and replaces the whole file."""
    before = as_text(contents)
    if before == after:
        out.say("the file has these values already; nothing was written")
        return
    name = str(path)
    for line in difflib.unified_diff(before.splitlines(), after.splitlines(), name, name, n=1, lineterm=""):
        out.say(escape(line))
    if not yes and not typer.confirm(f"Write this into {name}?"):
        out.say("nothing was written")
        raise typer.Exit(1)
    target = path.resolve()
    if target.read_bytes() != contents:
        raise ConfigurationError(where=name, problem="was changed meanwhile; nothing was written")
    try:
        replace(target, as_before(contents, after), stat.S_IMODE(target.stat().st_mode))
    except OSError as bad:
        raise ConfigurationError(where=name, problem=f"cannot be written: {bad}; it is unchanged") from None
    out.say(f"[bold]{escape(name)}[/] is written")
