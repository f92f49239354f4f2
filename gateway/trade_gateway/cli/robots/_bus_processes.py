"""Buses with a process of their own (``process = "own"``): each has a ``trade up`` as a supervised child process."""

import contextlib
import os
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Final

from trade import Container, where
from trade.errors import ConfigurationError, DeviceAbsent, TradeError
from trade_drivers import FaultInfo
from trade_gateway.process._signals import SignalEvent
from trade_robotfile import Robot

if TYPE_CHECKING:  # importing them delays the start of a robot that needs none of them
    from trade_gateway.config._children import Child
    from trade_gateway.supervisor import News, Supervisor

_LOOK_EVERY_S: Final = 0.05
_ANSWER_S: Final = 0.3
_ONE_PROCESS_ONLY: Final = ("TRADE_LISTEN", "TRADE_METRICS", "TRADE_CONTAINER")
"""Variables for the robot's own process: a second one cannot have the same port or name."""


class BusProcesses:
    """Starts them, restarts those that end, and ends them at its exit; each leaves its devices as the file says.

    Args:
        container: that of the robot's process.
        robot: the whole robot, with its file.
        buses: those with a process of their own.
        ports: replacements for the ports in the file.
        options: further options of ``trade up`` for all of them.
    """

    def __init__(
        self,
        container: Container,
        robot: Robot,
        buses: Sequence[str],
        ports: Mapping[str, str],
        options: Sequence[str],
    ) -> None:
        self._container = container
        self._robot = robot
        children = [_child(container, robot, bus, ports, options) for bus in buses]
        self.names: Final = [child.name for child in children]
        """Their containers."""
        self.news: Final[SimpleQueue[News]] = SimpleQueue()
        """Reports about them."""
        self._faults: dict[str, list[FaultInfo]] = {}
        """The open faults of each when it last answered."""
        self._supervisor = self._supervising(children) if children else None

    def _supervising(self, children: "Sequence[Child]") -> "Supervisor":
        from trade_gateway.supervisor import ChildServices, Supervisor  # noqa: PLC0415 - see above

        container, settings = self._container, self._container.settings
        folder = settings.state_dir or Path(tempfile.gettempdir())
        supervisor = Supervisor(lambda: container, self.news.put, folder / settings.system)
        supervisor.set_children(children)
        container.register_functions(ChildServices(supervisor), "supervisor")
        return supervisor

    def wait_until_up(self, leave: threading.Event | SignalEvent) -> None:
        """Waits until all are up, or until ``leave`` is set.

        Raises:
            DeviceAbsent: one ended instead, since a device does not answer.
            ConfigurationError: one ended for another reason; with its last words.
        """
        while self._supervisor is not None and not leave.is_set():
            children = self._supervisor.children()
            for child in children:
                if child.restarts or child.state in ("waiting", "given up"):
                    kind = DeviceAbsent if child.absent else ConfigurationError
                    raise kind(where=child.name, problem=child.why)
            if len(children) == len(self.names) and all(child.state == "up" for child in children):
                return
            leave.wait(_LOOK_EVERY_S)

    def faults(self) -> list[FaultInfo]:
        """Returns the open faults of their devices, newest first in each, as of its last answer."""
        for name in self.names:
            logs = where(name="faults", group=f"{self._robot.name}.faults", container=name)
            with contextlib.suppress(TradeError):
                for handle in self._container.services(logs):
                    self._faults[name] = handle.with_(deadline_s=_ANSWER_S)(open_only=True)
        return [fault for found in self._faults.values() for fault in found]

    def leave(self) -> None:
        """Begins to end them."""
        if self._supervisor is not None:
            self._supervisor.leave()

    def __enter__(self) -> "BusProcesses":
        return self

    def __exit__(self, *_: object) -> None:
        if self._supervisor is not None:
            self._supervisor.close()


def _child(container: Container, robot: Robot, bus: str, ports: Mapping[str, str], options: Sequence[str]) -> "Child":
    from trade_gateway.config._children import Child, Supervised  # noqa: PLC0415 - see above
    from trade_gateway.config._entry import ContainerSpec, ContainerTable  # noqa: PLC0415 - see above

    settings = container.settings
    name, file = f"{container.name}-{bus}", str(Path(robot.where).absolute())
    others = [part.name for part in (*robot.buses, *robot.cameras, *robot.sensors) if part.name != bus]
    words = ["--system", settings.system]
    words += [word for endpoint in settings.connect for word in ("--connect", endpoint)]
    words += ["up", file, "--name", name, *options]
    words += [word for part in others for word in ("--without", part)]
    words += ["--port", f"{bus}={ports[bus]}"] if bus in ports else []
    environment = {key: value for key, value in os.environ.items() if key not in _ONE_PROCESS_ONLY}
    named = {"TRADE_TLS": settings.tls, "TRADE_POLICY": settings.policy}
    environment.update({key: str(place) for key, place in named.items() if place is not None})
    return Child(ContainerSpec(name, ContainerTable(robot=file), words, {}), Supervised(), environment)
