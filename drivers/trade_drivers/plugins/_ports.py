"""Finds one port under two names in a robot file: a link to an adapter, a server's default port, an alias of a host."""

import os
import socket
import stat
from collections.abc import Hashable, Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from trade.errors import ConfigurationError
from trade_robotfile import Bus, CanBus, Robot, UrBus

_SOCKETCAND_PORT: Final = "29536"


class _Port(NamedTuple):
    """A port that a robot file names."""

    where: str
    """The file."""

    key: str
    """The key in the file."""
    shown: str
    """Its value."""
    device: Hashable
    """What it is on this host; equal for two names of one port."""


SeenPorts = dict[Hashable, _Port]
"""The ports of robots that were checked before."""


def check_ports(robot: Robot, ports: Mapping[str, str] | None = None, seen: SeenPorts | None = None) -> None:
    """Checks that no two buses or sensors have the same port. Opens nothing.

    Args:
        robot: the robot.
        ports: replacements for the ports in the file, by bus or device.
        seen: the ports of other robots on this host, to which those of this one are added.

    Raises:
        ConfigurationError: two keys name one port; names both.
    """
    seen = {} if seen is None else seen
    for port in _ports(robot, ports or {}):
        if (other := seen.setdefault(port.device, port)) is not port:
            place = other.key if other.where == port.where else f"{other.where}: {other.key}"
            problem = (
                f"{port.shown} is the port of {place} already, there as {other.shown}; "
                "two drivers cannot share a port: put the devices on one bus, or name another port"
            )
            raise ConfigurationError(where=f"{robot.where}: {port.key}", problem=problem)


def _ports(robot: Robot, ports: Mapping[str, str]) -> Iterator[_Port]:
    for bus in robot.buses:
        kind = "channel" if isinstance(bus, CanBus) else "host" if isinstance(bus, UrBus) else "port"
        shown = ports.get(bus.name, bus.port)
        yield _Port(robot.where, f"bus.{bus.name}.{kind}", shown, _of_bus(bus, shown))
    for sense in (*robot.cameras, *robot.sensors):
        shown = ports.get(sense.name, sense.options.get("port"))
        if isinstance(shown, str) and shown.startswith("/"):
            yield _Port(robot.where, f"{sense.key}.port", shown, _of_path(shown))


def _of_bus(bus: Bus, port: str) -> Hashable:
    if isinstance(bus, UrBus):
        return "ur", _address(port)
    return _of_can(*port.partition(":")[::2]) if isinstance(bus, CanBus) else _of_path(port)


def _of_can(interface: str, channel: str) -> Hashable:
    if channel.startswith("/"):  # a serial device, with its rate: /dev/ttyACM0@115200
        return _of_path(channel.partition("@")[0])
    if interface == "socketcand":
        server, _, name = channel.partition("/")
        host, _, number = server.partition(":")
        return interface, _address(host), number or _SOCKETCAND_PORT, name
    if interface == "socketcan":
        try:
            return interface, socket.if_nametoindex(channel)  # knows alternative names, too
        except OSError:
            pass
    return interface, channel


def _of_path(path: str) -> Hashable:
    try:
        status = Path(path).stat()
    except OSError:
        return os.path.realpath(path)
    return status.st_rdev if stat.S_ISCHR(status.st_mode) else os.path.realpath(path)


def _address(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except OSError:
        return host.lower()
