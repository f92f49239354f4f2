"""``trade doctor [ROBOT.toml ...]``: finds problems of this host and these robots, each with its fix."""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import replace
from rich.markup import escape

from trade.errors import ConfigurationError, TradeError
from trade.text_files import read_text
from trade.toml_files import read_toml_text
from trade_drivers import SerialBus, drivers, load, refusals
from trade_drivers.plugins._ports import SeenPorts
from trade_gateway.cli.hardware import _doctor_host as host
from trade_gateway.cli.hardware import _doctor_robot as robots
from trade_gateway.cli.hardware._doctor_brltty import brltty
from trade_gateway.cli.hardware._doctor_host import Finding
from trade_gateway.cli.hardware._scan import serial_ports
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import choice_of, visitor

_COLOURS = {"ok": "green", "warning": "yellow", "error": "red"}


def doctor(
    context: typer.Context,
    robot_files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="ROBOT.toml", help="Robot file whose lines and devices to check. Repeatable."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Check this host and its robots for problems, and suggest fixes.

    Host: rights and latency of serial ports, libraries, clock, real time, certificates, visible containers.
    Robot file: errors that its drivers find, ports, CAN interfaces, devices and their setup, missing watchdogs.
    Nothing is changed. Lines in use by a driver are skipped. The exit code is 1 on errors.

    For example: trade doctor rosie.toml
    """
    out, seen, paths = Output(as_json=as_json), SeenPorts(), robot_files or []
    found: list[Finding] = []
    for one in chain(_of_host(context, paths), *(_of_robot(path, seen) for path in paths)):
        found.append(one)
        if not as_json:
            _print(out, one)
    if as_json:
        out.data(found)
    errors = sum(one.level == "error" for one in found)
    warnings = sum(one.level == "warning" for one in found)
    out.say(f"{errors} errors, {warnings} warnings")
    if errors:
        raise typer.Exit(1)


def _of_host(context: typer.Context, paths: Sequence[Path]) -> Iterator[Finding]:
    yield from host.ports(serial_ports(), [line for path in paths for line in _lines_of(path)])
    yield from host.latencies()
    yield from brltty()
    if not paths:
        yield from host.libraries(sorted(drivers()), needed=False)
    yield from host.clock()
    yield from host.waits()
    yield from host.real_time()
    try:
        settings = choice_of(context).settings()
    except TradeError as bad:
        yield Finding(level="error", about="settings", text=str(bad), fix=_fix_of(bad))
        return
    if settings.tls is not None:
        yield from host.certificate(settings.tls)
    yield from host.multicast()
    try:
        with visitor(context) as member:
            yield from host.in_sight(member, settings.system)
    except TradeError as bad:
        yield Finding(
            level="error", about=f"system {settings.system}", text=str(bad), fix="the message says what helps"
        )


def _fix_of(bad: TradeError) -> str:
    """Suggests a fix; not to remove TRADE_TLS, which a system with certificates needs."""
    of_certificate = isinstance(bad, ConfigurationError) and bad.where.endswith(".pem")
    return "the message says what helps" if of_certificate else "correct that variable, or leave it out"


def _lines_of(path: Path) -> list[str]:
    """Returns the serial ports that a robot file names; none if it cannot be read, which is reported later."""
    try:
        return [bus.port for bus in load(path).buses if isinstance(bus, SerialBus)]
    except TradeError:
        return []


def _of_robot(path: Path, seen: SeenPorts | None = None) -> Iterator[Finding]:
    try:
        robot = load(path)
    except TradeError as bad:
        yield _no_robot(path) or Finding(
            level="error",
            about=str(path),
            text=str(bad).removeprefix(f"{path}: "),
            fix="correct the file; the message says where",
        )
        return
    known = {bus.driver for bus in robot.buses} & drivers().keys()
    yield from host.libraries(sorted(known), needed=True)
    wrong = dict(refusals(robot))
    yield from robots.shared(robot, seen)
    yield from robots.refused(robot, wrong)
    sound = replace(robot, buses=[bus for bus in robot.buses if bus.name not in wrong])
    yield from robots.numbered(robot)
    yield from robots.unwatched(sound)
    yield from robots.unmeasured(robot, path)
    yield from robots.interfaces(sound)
    yield from robots.devices(sound)
    yield from robots.controllers(sound)


def _no_robot(path: Path) -> Finding | None:
    """Returns a finding that the file is of another known kind, or None."""
    try:
        system = read_toml_text(read_text(path)).get("system")
    except (OSError, ValueError):
        return None
    if system is None:
        return None
    kind, check = (
        ("gateway", "trade gateway {} --check") if isinstance(system, str) else ("system", "trade system up {} --check")
    )
    text = f"is a {kind} file; trade doctor checks robot files, such as those that it names"
    return Finding(level="error", about=str(path), text=text, fix=check.format(path))


def _print(out: Output, one: Finding) -> None:
    out.say(f"[{_COLOURS[one.level]}]{one.level:7}[/]  {escape(one.about)}: {escape(one.text)}")
    if one.fix:
        out.say(f"         fix: {escape(one.fix)}")
