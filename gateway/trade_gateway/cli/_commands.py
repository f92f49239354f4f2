"""Finds the commands: those of the command line itself, those of the products beside it, and those of other packages.

A product lists its commands in ``commands.toml`` in its folder, as ``name = "module:object"``. Another package lists
them in the same way, as entry points of the group ``trade.commands``. The module of a command says where the help
shows it: ``SECTION``, and ``PLACE`` from 0 in that section. No module is imported before its command is asked for.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import typer

from trade.errors import ConfigurationError
from trade.toml_files import read_toml_text
from trade_gateway.terminal.sections import (
    HARDWARE,
    MOTION,
    OPERATION,
    ORDER,
    OTHERS,
    RIGHTS,
    ROBOTS,
    SERVICES,
    WATCHING,
)

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_GROUP: Final = "trade.commands"
_HERE: Final = "trade_gateway.cli"
_OWN: Final = {
    "up": (ROBOTS, "robots._up:up"),
    "gateway": (ROBOTS, "robots._gateway:gateway"),
    "hub": (ROBOTS, "robots._hub:hub"),
    "container": (ROBOTS, "robots._container:container"),
    "start": (ROBOTS, "robots._start:start"),
    "code": (ROBOTS, "robots._code:code"),
    "migrate": (ROBOTS, "robots._migrate:migrate"),
    "install": (OPERATION, "operation._install:install"),
    "backup": (OPERATION, "operation._backup:backup"),
    "restore": (OPERATION, "operation._backup:restore"),
    "scan": (HARDWARE, "hardware._scan:scan"),
    "set-id": (HARDWARE, "hardware._scan:set_id"),
    "set-baud": (HARDWARE, "hardware._scan:set_baud"),
    "calibrate": (HARDWARE, "hardware._calibrate:calibrate"),
    "doctor": (HARDWARE, "hardware._doctor:doctor"),
    "services": (SERVICES, "services._services:services"),
    "containers": (SERVICES, "services._services:containers"),
    "use": (SERVICES, "services._use:use"),
    "call": (SERVICES, "services._call:call"),
    "stream": (SERVICES, "services._stream:stream"),
    "lock": (MOTION, "motion._lock:lock"),
    "locks": (MOTION, "motion._locks:locks"),
    "unlock": (MOTION, "motion._locks:unlock"),
    "resume": (MOTION, "motion._locks:resume"),
    "stop": (MOTION, "motion._stop:stop"),
    "estop": (MOTION, "motion._estop:estop"),
    "watch": (WATCHING, "watching._watch:watch"),
    "top": (WATCHING, "watching._top:top"),
    "notifications": (WATCHING, "watching._notifications:notifications"),
    "hooks": (WATCHING, "watching._notifications:hooks"),
    "tracing": (WATCHING, "watching._trace:tracing"),
    "trace": (WATCHING, "watching._trace:trace"),
    "logs": (WATCHING, "watching._logs:logs"),
    "faults": (WATCHING, "watching._faults:app"),
    "audit": (WATCHING, "watching._audit:app"),
    "profile": (WATCHING, "watching._profile:profile"),
    "rules": (WATCHING, "watching._rules:app"),
    "policy": (RIGHTS, "rights._policy:app"),
}
"""By name, in the order of the help: the section, and the function or group of commands that implements it."""
_APART: Final = {"conformance": "trade-checks", "drill": "trade-checks"}
"""Commands that a package of this project has, which need not be installed."""
_LAST: Final = 1000


class Command(NamedTuple):
    """One imported command."""

    name: str
    section: str
    implementation: Any
    """A function, or a `typer.Typer` with subcommands."""
    place: int = _LAST
    options: Mapping[str, Any] = {}
    """Further arguments of `typer.Typer.command`."""


def find(name: str | None) -> list[Command]:
    """Imports a command; all commands in the order of the help if there is none of that name."""
    if name in _OWN:
        return [_own(name)]
    products = _products()
    if name in products:
        return [_of_product(name, products[name])]
    others = _others(products)
    if name in others:
        return [_of_package(name, others[name])]
    if name in _APART:
        return [_broken(name, f"needs {_APART[name]}; pip install {_APART[name]}")]
    return _in_order(products, others)


def _in_order(products: Mapping[str, str], others: "Mapping[str, list[EntryPoint]]") -> list[Command]:
    sections: dict[str, list[Command]] = {section: [] for section in ORDER}
    for name in _OWN:
        command = _own(name)
        sections[command.section].append(command)
    added = sorted((_of_product(*one) for one in products.items()), key=lambda command: command.place)
    added += [_of_package(*one) for one in sorted(others.items())]
    for command in added:
        sections.setdefault(command.section, []).insert(command.place, command)
    return [command for section in sections.values() for command in section]


def _own(name: str) -> Command:
    section, where = _OWN[name]
    module, _, attribute = where.partition(":")
    room = import_module(f"{_HERE}.{module}")
    return Command(name, section, getattr(room, attribute), options=getattr(room, "COMMAND", {}))


def _products() -> dict[str, str]:
    """Returns ``module:object`` of the commands of all products, by name."""
    tables = sorted(Path(__file__).parent.parent.glob("*/commands.toml"))
    return {name: where for table in tables for name, where in read_toml_text(table.read_text("utf-8")).items()}


def _of_product(name: str, where: str) -> Command:
    module, _, attribute = where.partition(":")
    room = import_module(module)
    return Command(name, room.SECTION, getattr(room, attribute), getattr(room, "PLACE", _LAST))


def _others(products: Mapping[str, str]) -> "dict[str, list[EntryPoint]]":
    """Returns the entry points of other packages by name. None of them replaces a command of this package."""
    from importlib.metadata import entry_points  # noqa: PLC0415 - takes 40 ms, which `trade stop` does without

    found: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=_GROUP):
        if point.name not in _OWN and point.name not in products:
            found.setdefault(point.name, []).append(point)
    return found


def _of_package(name: str, points: "list[EntryPoint]") -> Command:
    """Imports a command of another package. One that is broken fails only when it is run."""
    origins = sorted({_origin(point) for point in points})
    if len(origins) > 1:
        return _broken(name, f"two packages have a command of this name: {' and '.join(origins)}. Uninstall one")
    try:
        implementation = points[0].load()
        trial = typer.Typer()
        _add(trial, Command(name, OTHERS, implementation))
        typer.main.get_command(trial)
        room = import_module(points[0].module)
        return Command(name, getattr(room, "SECTION", OTHERS), implementation, getattr(room, "PLACE", _LAST))
    except Exception as error:  # noqa: BLE001 - whatever is wrong with it, the other commands run
        return _broken(name, f"{origins[0]} cannot be loaded: {error}")


def _origin(point: "EntryPoint") -> str:
    return f"{point.value} of {point.dist.name} {point.dist.version}" if point.dist is not None else point.value


def _broken(name: str, problem: str) -> Command:
    def fail() -> None:
        raise ConfigurationError(where=f"trade {name}", problem=problem)

    settings = {"ignore_unknown_options": True, "allow_extra_args": True}
    return Command(name, OTHERS, fail, options={"context_settings": settings, "help": f"Broken: {problem}."})


def _add(made: typer.Typer, command: Command) -> None:
    if isinstance(command.implementation, typer.Typer):
        made.add_typer(command.implementation, name=command.name, rich_help_panel=command.section)
    else:
        add: Callable[[Any], Any] = made.command(command.name, rich_help_panel=command.section, **command.options)
        add(command.implementation)


def add_all(made: typer.Typer, only: str | None) -> None:
    """Adds one command, or all of them if there is none of that name."""
    for command in find(only):
        _add(made, command)
