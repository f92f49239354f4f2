"""``trade scan``, ``trade set-id``, ``trade set-baud``: who is on a line, and giving each its own id and rate."""

import re
from collections.abc import Sequence
from glob import glob
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer
from rich.markup import escape

from trade.errors import ConfigurationError
from trade_drivers import AnyDriver, Commissioner, Found, drivers, load_driver
from trade_drivers import scan as scan_line
from trade_gateway._usage import UsageError
from trade_gateway.cli._options import Json
from trade_gateway.cli._output import Output, complain
from trade_gateway.cli.hardware._robot_file_template import first_file

__all__ = ["scan", "serial_ports", "set_baud", "set_id"]

_PORTS: Final = ("/dev/serial/by-id/*", "/dev/ttyUSB*", "/dev/ttyACM*", "/dev/cu.usb*")
_CAN: Final = re.compile(r"[a-z0-9_]+:.+")
"""How python-can's buses are named here: ``socketcan:can0``."""
_CAN_KIND: Final = "280"
"""ARPHRD_CAN of linux/if_arp.h."""
_COLUMNS: Final = ("PORT", "BAUD", "ID", "MODEL", "FIRMWARE", "DRIVER", "PROBLEM")

Port = Annotated[str, typer.Option(help="The serial device.")]
DriverName = Annotated[str | None, typer.Option("--driver", help="Only devices of this driver.")]
Baud = Annotated[int | None, typer.Option(help="The rate it speaks at now; by default it is looked for.")]
Model = Annotated[str | None, typer.Option(help="Refuse if it is another model than this one.")]


class Here(Found, frozen=True, kw_only=True):
    """A device, and where it was found."""

    port: str


def scan(
    port: Annotated[
        list[str] | None, typer.Option(help="A serial device, or socketcan:can0; repeatable. Without one: lists them.")
    ] = None,
    host: Annotated[list[str] | None, typer.Option(help="The controller of an arm; repeatable.")] = None,
    driver: DriverName = None,
    bauds: Annotated[str | None, typer.Option(help="Rates to try, as in 57600,1000000; by default all.")] = None,
    ids: Annotated[str | None, typer.Option(help="Whom to ask, as in 1-20,100; by default everybody.")] = None,
    write: Annotated[Path | None, typer.Option(metavar="ROBOT.toml", help="Write a robot file to begin with.")] = None,
    as_json: Json = False,
) -> None:
    """Find out who is on a serial line or a CAN bus: ids, models, rates. Nothing is written to any device.

    It needs the line for itself, and ends at the first device whose torque is on. One driver asks after the
    other, until one finds something; --driver, --bauds and --ids make it faster. The exit code is 1 if nobody answers,
    or one that does cannot be used as it is.

    For example: trade scan --port /dev/ttyUSB0 --write rosie.toml
    """
    out = Output(as_json=as_json)
    if not port and not host:
        _list_ports(out)
        return
    if write is not None and write.exists():
        raise UsageError(where=str(write), problem="is there already; choose another name, or remove it")
    rates, wanted = _numbers(bauds, "--bauds"), _numbers(ids, "--ids")
    found: list[Here] = []
    for line in port or []:
        here = _scan_port(out, line, driver, rates, wanted)
        found += [Here(**msgspec.structs.asdict(one), port=line) for one in here]
    found += [Here(**msgspec.structs.asdict(_arm(one)), port=one) for one in host or []]
    if as_json:
        out.data(found)
    elif found:
        out.table(_COLUMNS, [_row(one) for one in found])
    if not found:
        out.say("nobody answers; is the power on, and the cable in? A device that speaks at another rate is not heard")
        raise typer.Exit(1)
    if write is not None:
        write.write_text(first_file([(one.port, one) for one in found], write), encoding="utf-8")
        out.say(f"{escape(str(write))} is a robot file to begin with: give its devices names, then measure each joint")
        out.say(f"Next: [bold]trade calibrate {escape(str(write))} JOINT[/]")
    if any(one.problem for one in found):
        raise typer.Exit(1)


def set_id(
    port: Port,
    old: Annotated[int, typer.Option("--from", help="The id it has.")],
    new: Annotated[int, typer.Option("--to", help="The id it gets.")],
    baud: Baud = None,
    driver: DriverName = None,
    model: Model = None,
    as_json: Json = False,
) -> None:
    """Give one device another id, which it keeps without power. Refused while its torque is on, or the id is taken.

    Devices fresh from the factory have the same id: plug in one, give it its own, plug in the next.

    For example: trade set-id --port /dev/ttyUSB0 --from 1 --to 2
    """
    out = Output(as_json=as_json)
    commissioner, before = _one(port, old, baud, driver, model)
    now = commissioner.set_id(port, before.baud, old, new)
    _tell(out, now, f"{now.model} has id {now.id} now (it had {old}); write it on its housing")


def set_baud(
    port: Port,
    device_id: Annotated[int, typer.Option("--id", help="Whose.")],
    to: Annotated[int, typer.Option(help="Bits per second from now on.")],
    baud: Baud = None,
    driver: DriverName = None,
    model: Model = None,
    as_json: Json = False,
) -> None:
    """Have one device speak at another rate, which it keeps without power. Refused while its torque is on.

    All devices of one line must speak at the same rate.

    For example: trade set-baud --port /dev/ttyUSB0 --id 2 --to 1000000
    """
    out = Output(as_json=as_json)
    commissioner, before = _one(port, device_id, baud, driver, model)
    now = commissioner.set_baud(port, before.baud, device_id, to)
    _tell(out, now, f"{now.model}, id {now.id}, speaks at {now.baud} baud now (before: {before.baud})")


def serial_ports() -> list[str]:
    """The serial devices of this host, those with lasting names first."""
    return [path for pattern in _PORTS for path in sorted(glob(pattern))]  # noqa: PTH207 - the names as they are


def can_ports(folder: Path = Path("/sys/class/net")) -> list[str]:
    """The CAN interfaces of this host, as python-can is told of them."""
    kinds = {path.parent.name: path.read_text(encoding="ascii").strip() for path in sorted(folder.glob("*/type"))}
    return [f"socketcan:{name}" for name, kind in kinds.items() if kind == _CAN_KIND]


def _list_ports(out: Output) -> None:
    ports = [*serial_ports(), *can_ports()]
    if out.as_json:
        out.data(ports)
    for one in ports if not out.as_json else ():
        out.say(escape(one))
    if ports:
        out.say("a scan sends bytes, so say where to: [bold]trade scan --port PORT[/]")
    else:
        out.say("there is no serial port and no CAN interface; is the adapter plugged in?")


def commissioners(name: str | None) -> dict[str, Commissioner]:
    """What sets devices up, by driver: of all drivers, or of one.

    Raises:
        ConfigurationError: there is no such driver, or its devices are set up otherwise.
    """
    found: dict[str, Commissioner] = {}
    for one in sorted(drivers()) if name is None else [name]:
        made = load_driver(one, "--driver", AnyDriver).commissioner
        if made is not None:
            found[one] = made()
    if name is not None and not found:
        problem = f"the devices of driver {name} are set up by the vendor's tool; it has no scan"
        raise ConfigurationError(where="--driver", problem=problem)
    return found


def _scan_port(out: Output, port: str, driver: str | None, bauds: Sequence[int], ids: Sequence[int]) -> list[Found]:
    """What the first driver finds that finds anything; on a CAN bus, where several kinds may be, what all find."""
    everything: list[Found] = []
    wire = "can" if _CAN.fullmatch(port) and not Path(port).exists() else "serial"
    for name, commissioner in commissioners(driver).items():
        if commissioner.wire != wire:
            continue

        def told(baud: int, count: int, name: str = name) -> None:
            out.say(f"{escape(port)}: {name} at {baud} baud: {count or 'nobody'}")

        rates = [baud for baud in bauds or commissioner.bauds if driver is not None or baud in commissioner.bauds]
        wanted = [one for one in ids if one in commissioner.ids]
        if not rates or (ids and not wanted):
            continue
        try:
            found = scan_line(commissioner, port, rates, wanted, told)
        except ConfigurationError as bad:
            if driver is not None or bad.where != f"driver {name}":
                raise
            complain(f"not looked for: {bad}")  # its library is not installed
            continue
        everything += found
        if found and wire == "serial":
            break
    return everything


def _arm(host: str) -> Found:
    from trade_drivers.vendors.ur import identify  # noqa: PLC0415 - loads what other commands do not need

    return identify(host)


def _one(
    port: str, device_id: int, baud: int | None, driver: str | None, model: str | None
) -> tuple[Commissioner, Found]:
    """The one device of that id on a line, and what sets it up."""
    where = f"{port}, id {device_id}"
    found = _scan_port(Output(as_json=True), port, driver, [] if baud is None else [baud], [device_id])
    if not found:
        raise ConfigurationError(where=where, problem="nobody answers; `trade scan` shows who does, and at which rate")
    if len(found) > 1:
        rates = ", ".join(str(one.baud) for one in found)
        raise ConfigurationError(where=where, problem=f"there is one at each of {rates} baud; say --baud")
    if model is not None and not found[0].problem and found[0].model != model:
        raise ConfigurationError(where=where, problem=f"is {found[0].model}, not {model}; nothing was changed")
    return commissioners(found[0].driver)[found[0].driver], found[0]


def _tell(out: Output, now: Found, text: str) -> None:
    if out.as_json:
        out.data(now)
    out.say(escape(text))


def _row(one: Here) -> tuple[str, ...]:
    baud, device_id = ("", "") if one.kind == "arm" else (str(one.baud), str(one.id))
    return one.port, baud, device_id, one.model, one.firmware, one.driver, one.problem


def _numbers(words: str | None, option: str) -> list[int]:
    """``1-3,9`` as numbers."""
    numbers: list[int] = []
    for word in (words or "").split(",") if words else ():
        first, dash, last = word.strip().partition("-")
        try:
            numbers += range(int(first), int(last if dash else first) + 1)
        except ValueError:
            raise UsageError(where=option, problem=f"{word!r} is no number and no range, such as 1-20") from None
    return numbers
