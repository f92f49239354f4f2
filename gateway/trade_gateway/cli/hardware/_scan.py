"""``trade scan``, ``trade set-id``, ``trade set-baud``: find devices on a line, and set their ids and rates."""

import re
from collections.abc import Sequence
from glob import glob
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer
from rich.markup import escape

from trade.errors import ConfigurationError
from trade_drivers import AnyDriver, Commissioner, ScannedDevice, drivers, load_driver
from trade_drivers import scan as scan_line
from trade_gateway._usage import UsageError
from trade_gateway.cli.hardware._robot_file_template import first_file
from trade_gateway.terminal._options import CONNECTION, OUTPUT, SELECT, Json
from trade_gateway.terminal._output import Output, complain

_PORTS: Final = ("/dev/serial/by-id/*", "/dev/ttyUSB*", "/dev/ttyACM*", "/dev/cu.usb*")
_CAN: Final = re.compile(r"[a-z0-9_]+:.+")
"""The name of a python-can bus: ``socketcan:can0``."""
_CAN_KIND: Final = "280"
"""ARPHRD_CAN of linux/if_arp.h."""
_COLUMNS: Final = ("PORT", "BAUD", "ID", "MODEL", "FIRMWARE", "DRIVER", "PROBLEM")

Port = Annotated[str, typer.Option(rich_help_panel=CONNECTION, help="Serial port of the device.")]
DriverName = Annotated[
    str | None, typer.Option("--driver", rich_help_panel=SELECT, help="Consider only devices of this driver.")
]
Baud = Annotated[
    int | None,
    typer.Option(
        rich_help_panel=CONNECTION, metavar="BAUD", help="Current rate of the device, in baud; by default searched for."
    ),
]
Model = Annotated[str | None, typer.Option(rich_help_panel=SELECT, help="Refuse if the device is of another model.")]


class FoundOnPort(ScannedDevice, frozen=True, kw_only=True):
    """A device, with the port that it was found on."""

    port: str


def scan(
    port: Annotated[
        list[str] | None,
        typer.Option(
            rich_help_panel=CONNECTION, help="Serial port, or socketcan:can0. Repeatable. Default: list the ports."
        ),
    ] = None,
    host: Annotated[
        list[str] | None, typer.Option(rich_help_panel=CONNECTION, help="Host of an arm's controller. Repeatable.")
    ] = None,
    driver: DriverName = None,
    bauds: Annotated[
        str | None, typer.Option(rich_help_panel=SELECT, help="Rates to try, in baud: 57600,1000000. Default: all.")
    ] = None,
    ids: Annotated[str | None, typer.Option(rich_help_panel=SELECT, help="Ids to ask: 1-20,100. Default: all.")] = None,
    write: Annotated[
        Path | None,
        typer.Option(metavar="ROBOT.toml", rich_help_panel=OUTPUT, help="Write a template of a robot file."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find devices on a serial line or a CAN bus: ids, models, rates.

    Nothing is written to devices. No other program may use the line.
    The scan ends at the first device whose torque is on.
    Each driver scans in turn until one finds a device. --driver, --bauds and --ids make a scan faster.
    The exit code is 1 if no device answers, or if a device that answers cannot be used as it is.

    For example: trade scan --port /dev/ttyUSB0 --write rosie.toml
    """
    out = Output(as_json=as_json)
    if not port and not host:
        _list_ports(out)
        return
    if write is not None and write.exists():
        raise UsageError(where=str(write), problem="exists already; choose another name, or remove the file")
    rates, wanted = _numbers(bauds, "--bauds"), _numbers(ids, "--ids")
    found: list[FoundOnPort] = []
    for line in port or []:
        found_here = _scan_port(out, line, driver, rates, wanted)
        found += [FoundOnPort(**msgspec.structs.asdict(one), port=line) for one in found_here]
    found += [FoundOnPort(**msgspec.structs.asdict(_arm(one)), port=one) for one in host or []]
    if as_json:
        out.data(found)
    elif found:
        out.table(_COLUMNS, [_row(one) for one in found])
    if not found:
        out.say("no device answers; check power and cable. A device at another rate is not found")
        raise typer.Exit(1)
    if write is not None:
        write.write_text(first_file([(one.port, one) for one in found], write), encoding="utf-8")
        out.say(f"{escape(str(write))} is a template of a robot file: name its devices, then measure each joint")
        out.say(f"Next: [bold]trade calibrate {escape(str(write))} JOINT[/]")
    if any(one.problem for one in found):
        raise typer.Exit(1)


def set_id(
    port: Port,
    old: Annotated[int, typer.Option("--from", help="Current id of the device.")],
    new: Annotated[int, typer.Option("--to", help="New id of the device.")],
    baud: Baud = None,
    driver: DriverName = None,
    model: Model = None,
    as_json: Json = False,
) -> None:
    """Give a device another id, which it keeps without power.

    It is refused while the device's torque is on, or if the id is taken.
    New devices all have the same id: plug in one, give it an id, then plug in the next.

    For example: trade set-id --port /dev/ttyUSB0 --from 1 --to 2
    """
    out = Output(as_json=as_json)
    commissioner, before = _one(port, old, baud, driver, model)
    now = commissioner.set_id(port, before.baud, old, new)
    _print(out, now, f"{now.model} has id {now.id} now (it had {old}); write it on its housing")


def set_baud(
    port: Port,
    device_id: Annotated[int, typer.Option("--id", help="Id of the device.")],
    to: Annotated[int, typer.Option(metavar="BAUD", help="New rate, in baud.")],
    baud: Baud = None,
    driver: DriverName = None,
    model: Model = None,
    as_json: Json = False,
) -> None:
    """Set a device to another baud rate, which it keeps without power.

    It is refused while the device's torque is on. All devices of one line must have the same rate.

    For example: trade set-baud --port /dev/ttyUSB0 --id 2 --to 1000000
    """
    out = Output(as_json=as_json)
    commissioner, before = _one(port, device_id, baud, driver, model)
    now = commissioner.set_baud(port, before.baud, device_id, to)
    _print(out, now, f"{now.model}, id {now.id}, uses {now.baud} baud now (before: {before.baud})")


def serial_ports() -> list[str]:
    """Returns the serial ports of this host, those with lasting names first."""
    return [path for pattern in _PORTS for path in sorted(glob(pattern))]  # noqa: PTH207 - the names as they are


def can_ports(folder: Path = Path("/sys/class/net")) -> list[str]:
    """Returns the CAN interfaces of this host, as python-can names them."""
    kinds = {path.parent.name: path.read_text(encoding="ascii").strip() for path in sorted(folder.glob("*/type"))}
    return [f"socketcan:{name}" for name, kind in kinds.items() if kind == _CAN_KIND]


def _list_ports(out: Output) -> None:
    ports = [*serial_ports(), *can_ports()]
    if out.as_json:
        out.data(ports)
    for one in ports if not out.as_json else ():
        out.say(escape(one))
    if ports:
        out.say("to scan a port, which sends bytes to it: [bold]trade scan --port PORT[/]")
    else:
        out.say("there is no serial port and no CAN interface; is the adapter plugged in?")


def commissioners(name: str | None) -> dict[str, Commissioner]:
    """Returns the commissioners by driver: of all drivers, or of one.

    Raises:
        ConfigurationError: the driver does not exist, or its devices are set up otherwise.
    """
    found: dict[str, Commissioner] = {}
    for one in sorted(drivers()) if name is None else [name]:
        made = load_driver(one, "--driver", AnyDriver).commissioner
        if made is not None:
            found[one] = made()
    if name is not None and not found:
        problem = f"driver {name} has no scan; set its devices up with the vendor's tool"
        raise ConfigurationError(where="--driver", problem=problem)
    return found


def _scan_port(
    out: Output, port: str, driver: str | None, bauds: Sequence[int], ids: Sequence[int]
) -> list[ScannedDevice]:
    """Scans with each driver until one finds devices; on a CAN bus, which can have several kinds, with all."""
    everything: list[ScannedDevice] = []
    wire = "can" if _CAN.fullmatch(port) and not Path(port).exists() else "serial"
    for name, commissioner in commissioners(driver).items():
        if commissioner.wire != wire:
            continue

        def report(baud: int, count: int, name: str = name) -> None:
            out.say(f"{escape(port)}: {name} at {baud} baud: {count or 'no device'}")

        rates = [baud for baud in bauds or commissioner.bauds if driver is not None or baud in commissioner.bauds]
        wanted = [one for one in ids if one in commissioner.ids]
        if not rates or (ids and not wanted):
            continue
        try:
            found = scan_line(commissioner, port, rates, wanted, report)
        except ConfigurationError as bad:
            if driver is not None or bad.where != f"driver {name}":
                raise
            complain(f"not scanned for: {bad}")  # its library is not installed
            continue
        everything += found
        if found and wire == "serial":
            break
    return everything


def _arm(host: str) -> ScannedDevice:
    from trade_drivers.vendors.ur import identify  # noqa: PLC0415 - loads what other commands do not need

    return identify(host)


def _one(
    port: str, device_id: int, baud: int | None, driver: str | None, model: str | None
) -> tuple[Commissioner, ScannedDevice]:
    """Returns the only device of an id on a line, and its commissioner."""
    where = f"{port}, id {device_id}"
    found = _scan_port(Output(as_json=True), port, driver, [] if baud is None else [baud], [device_id])
    if not found:
        raise ConfigurationError(
            where=where, problem="no device answers; `trade scan` shows which ids answer at which rate"
        )
    if len(found) > 1:
        rates = ", ".join(str(one.baud) for one in found)
        raise ConfigurationError(where=where, problem=f"devices answer at {rates} baud; choose one with --baud")
    if found[0].problem:  # also if it is gone at the next look: the model is not known then
        raise ConfigurationError(where=where, problem=f"{found[0].problem}; nothing was changed")
    if model is not None and found[0].model != model:
        raise ConfigurationError(where=where, problem=f"is {found[0].model}, not {model}; nothing was changed")
    return commissioners(found[0].driver)[found[0].driver], found[0]


def _print(out: Output, now: ScannedDevice, text: str) -> None:
    if out.as_json:
        out.data(now)
    out.say(escape(text))


def _row(one: FoundOnPort) -> tuple[str, ...]:
    baud, device_id = ("", "") if one.kind == "arm" else (str(one.baud), str(one.id))
    return one.port, baud, device_id, one.model, one.firmware, one.driver, one.problem


def _numbers(words: str | None, option: str) -> list[int]:
    """Parses numbers and ranges: ``1-3,9``."""
    numbers: list[int] = []
    for word in (words or "").split(",") if words else ():
        first, dash, last = word.strip().partition("-")
        try:
            numbers += range(int(first), int(last if dash else first) + 1)
        except ValueError:
            raise UsageError(where=option, problem=f"{word!r} is neither a number nor a range such as 1-20") from None
    return numbers
