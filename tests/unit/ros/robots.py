"""A robot of TRADE that records what is done to it, a bridge, and nodes of ROS around them."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.support.waiting import wait_until
from tests.unit.ros.memory_graph import MemoryGraph, MemoryRos
from trade import Container, Resource, permit, service
from trade.testing import MemorySystem
from trade_gateway.ros._bridge import Bridge
from trade_gateway.ros._file import RosFile, read_ros_file

PATIENCE_S = 60.0
DEFINITIONS = Path(__file__).parent / "definitions"


class Part:
    """Moves until it is stopped, or to an angle at once."""

    def __init__(self, name: str) -> None:
        self.resources = (Resource(name),)
        self.angle = 0.0
        self.stopped = threading.Event()
        self.goes = threading.Event()
        self.stops = 0
        self.commands: list[float] = []
        self.spins = 0
        self.silent = False
        self.takes_over = False
        """A command ends the one before it, as drivers do; else each is done at once."""
        self._moves = 0

    @service(effect="read")
    def state(self) -> dict[str, float]:
        """Where it is."""
        if self.silent:
            raise TimeoutError("nothing was heard of it")
        return {"position_rad": self.angle}

    @service(effect="read")
    def angle_rad(self) -> float:
        """Where it is, as a number."""
        return self.angle

    @service(cancel="stop")
    def turn(self, angle_rad: float, speed_rad_s: float = 1.0) -> float:
        """Turn there."""
        self.commands.append(angle_rad)
        self.angle = angle_rad
        return angle_rad

    @service(cancel="stop")
    def go(self, angle_rad: float) -> None:
        """Be on the way there until it is stopped, or gets another angle."""
        self._moves += 1
        mine = self._moves
        self.commands.append(angle_rad)
        self.resources[0].moving = True
        self.goes.set()
        with permit(self.resources) as permitted:
            permitted.gate()
            wait_until(lambda: self._moves != mine or self.stopped.is_set())
        if self._moves == mine:
            self.resources[0].moving = False

    @service(cancel="stop")
    def spin(self) -> None:
        """Turn until stopped."""
        self.spins += 1
        self.resources[0].moving = True
        self.goes.set()
        self.stopped.wait(PATIENCE_S)

    @service
    def power(self, on: bool) -> None:
        """Switch it."""
        self.commands.append(float(on))

    @service(effect="stop")
    def stop(self) -> None:
        """Stop."""
        self.stops += 1
        self.resources[0].moving = False
        self.stopped.set()


class Robot:
    """Of two parts."""

    def __init__(self, container: Container) -> None:
        self.container = container
        self.head, self.legs = Part("head"), Part("legs")
        container.register(self.head, "rosie.head")
        container.register(self.legs, "rosie.legs")


class Stand:
    """A robot, a ROS system, and what is between them."""

    def __init__(self, memory: MemorySystem, folder: Path) -> None:
        self.memory = memory
        self.ros = MemoryRos(folders=[DEFINITIONS])
        self.folder = folder
        self.robot = Robot(memory.container("robot", identity="robot"))
        self.container = memory.container("bridge", identity="bridge")
        memory.settle()
        self.said: list[str] = []
        self.bridge: Bridge | None = None

    def read(self, text: str, head: str = "[ros]\nversion = 2\n") -> RosFile:
        path = self.folder / "ros.toml"
        path.write_text(f"{head}{text}")
        return read_ros_file(path)

    def up(self, text: str, head: str = "[ros]\nversion = 2\ngrace_s = 0\n") -> Bridge:
        """The bridge of a file."""
        graph = self.ros.graph("/trade")
        self.bridge = Bridge(self.container, graph, self.read(text, head), self.said.append)
        assert self.bridge.settled(PATIENCE_S)
        return self.bridge

    def node(self, name: str = "/teleop") -> MemoryGraph:
        return self.ros.graph(name)

    def trigger(self, node: MemoryGraph, name: str) -> dict[str, Any]:
        return node.call(name, "std_srvs/srv/Trigger", {}, PATIENCE_S)

    def set_bool(self, node: MemoryGraph, name: str, value: bool) -> dict[str, Any]:
        return node.call(name, "std_srvs/srv/SetBool", {"data": value}, PATIENCE_S)

    def close(self) -> None:
        self.robot.head.stopped.set()
        self.robot.legs.stopped.set()
        if self.bridge is not None:
            self.bridge.close()
        self.ros.close()


def apart(do: Callable[[], object]) -> tuple[threading.Thread, list[Any]]:
    """Do it on a thread of its own; what it returns or raises is put into the list."""
    ended: list[Any] = []

    def run() -> None:
        try:
            ended.append(do())
        except Exception as error:  # noqa: BLE001 - it is what is asked for
            ended.append(error)

    thread = threading.Thread(target=run, name="test-apart", daemon=True)
    thread.start()
    return thread, ended
