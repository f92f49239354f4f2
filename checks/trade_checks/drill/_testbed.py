"""The testbed of a drill: a simulator, the driver, two linked gateways and a caller, each in its own process.

The driver and the caller reach each other only through the gateways, and these only through a relay that can be
frozen. Everything is on the loopback interface, in a separate system.
"""

import json
import secrets
import socket
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from trade.errors import ConfigurationError
from trade_checks.drill._caller import Order
from trade_checks.drill._scenes import VALID_S, Scene
from trade_checks.drill._targets import Target
from trade_gateway.process._json_child import JsonChild, bare_environment
from trade_robotfile import Robot


class _Event(msgspec.Struct, frozen=True):
    """The fields of a line of the byte log that a drill needs."""

    t: float
    name: str = ""
    joint: str = ""


class Judge:
    """Reads a byte log while it is written, each line once.

    Args:
        log: the file.
    """

    def __init__(self, log: Path) -> None:
        self._log = log
        self._at = 0
        self._decoder = msgspec.json.Decoder(_Event)
        self._moves: dict[str, list[tuple[float, bool]]] = {}

    def look(self) -> None:
        """Reads the new lines."""
        with self._log.open("rb") as file:
            file.seek(self._at)
            whole, ended, _ = file.read().rpartition(b"\n")
        self._at += len(whole) + len(ended)
        for line in whole.splitlines():
            if b'"motion_started"' in line or b'"at_rest"' in line:
                event = self._decoder.decode(line)
                self._moves.setdefault(event.joint, []).append((event.t, event.name == "motion_started"))

    def moves(self, joint: str, at: float | None = None) -> bool:
        """Whether the joint moved at that time on CLOCK_MONOTONIC; without one, at the last line read."""
        known = [moving for t, moving in self._moves.get(joint, []) if at is None or t <= at]
        return bool(known) and known[-1]

    def rested(self, joint: str) -> float:
        """The time at which it last came to rest; KeyError: it never did."""
        times = [t for t, moving in self._moves.get(joint, []) if not moving]
        if not times:
            raise KeyError(joint)
        return times[-1]

    def began(self, joint: str, since: float) -> float | None:
        """The time of its first motion after that time; None: it did not move."""
        return next((t for t, moving in self._moves.get(joint, []) if moving and t > since), None)


if TYPE_CHECKING:
    from trade_hil_sim import SimProcess


UP_S: Final = 60.0
"""Time for a process to start, in seconds; a busy computer needs seconds to import."""


class Testbed:
    """All processes of a drill, until it is closed.

    Args:
        robot: the robot of the robot file.
        left_out: the parts that are not started.
        sim: simulates the buses of the targets.
        folder: for the drill's own files.
    """

    def __init__(self, robot: Robot, left_out: Sequence[str], sim: "SimProcess", folder: Path) -> None:
        self._sim = sim
        self._folder = folder
        self._unplugged: list[str] = []
        self._off: list[str] = []
        self._system = f"drill-{secrets.token_hex(3)}"
        self._secret = f"drill:{secrets.token_hex(16)}"
        self._actors: dict[str, JsonChild] = {}
        self.judge = Judge(sim.log_path)
        ports = [word for bus, port in sim.ports.items() for word in ("--port", f"{bus}={port}")]
        without = [word for part in left_out for word in ("--without", part)]
        self._driver = ["up", robot.where, *ports, *without, "--name", "driver", "--json"]
        self._near, self._far = _free_ports(2)

    def begin(self) -> None:
        """Starts the processes. Raises ChildFailed."""
        self._actors["link"] = self._actor(
            "link", ["trade_checks.drill._tcp_relay", str(self._near), str(self._far)], {}
        )
        to_near, to_far = self._actors["link"].read_message(UP_S)["ports"]
        self._write_gateway("gateway", self._near, dials=to_far)
        self._write_gateway("lab", self._far, dials=to_near)
        for name in ("gateway", "lab", "driver"):
            self._start(name)

    def call(self, scene: Scene, targets: Sequence[Target]) -> JsonChild:
        """Starts a caller that has found and enabled its targets, and waits for its cue. Raises ChildFailed."""
        orders = [self._order(scene, target) for target in targets]
        words = ["trade_checks.drill._caller", msgspec.json.encode(orders).decode()]
        caller = self._actors["caller"] = self._actor("caller", words, self._settings("caller", self._far))
        caller.read_message(UP_S)
        return caller

    def strike(self, scene: Scene, targets: Sequence[Target]) -> float:
        """Causes the scene's failure; returns the time on CLOCK_MONOTONIC immediately before."""
        done_at = time.monotonic()
        match scene.failure:
            case "kill":
                self._actors[scene.whom].kill()
            case "freeze":
                self._actors[scene.whom].freeze()
            case "hush":
                self._actors[scene.whom].tell()
            case "unplug":
                self._unplugged = [target.bus for target in targets]
                for bus in self._unplugged:
                    self._sim.control.unplug(bus)
            case "bus_off":
                self._off = [target.bus for target in targets]
                for bus in self._off:
                    self._switch(bus, off=True)
        return done_at

    def recover(self) -> None:
        """Reverses the failure: resumes, restarts or reconnects. Raises ChildFailed."""
        for actor in self._actors.values():
            actor.wake()
        for bus in self._unplugged:
            self._sim.control.replug(bus)
        for bus in self._off:
            self._switch(bus, off=False)
        self._unplugged, self._off = [], []
        for name in ("gateway", "driver"):
            if not self._actors[name].running:
                self._actors[name].close(gently=False)
                self._start(name)

    def dismiss(self) -> None:
        """Ends the caller."""
        if caller := self._actors.pop("caller", None):
            caller.close(gently=False)

    def look(self) -> None:
        """Has the judge read the log up to now."""
        self._sim.control.state()  # simulated devices update their state when it is requested
        self.judge.look()

    def close(self) -> None:
        """Ends all processes, the driver before its gateway. Idempotent."""
        self.dismiss()
        for name in ("driver", "lab", "link", "gateway"):
            if actor := self._actors.pop(name, None):
                actor.close(gently=name != "link")

    def _start(self, name: str) -> None:
        """Starts a `trade` command."""
        words = self._driver if name == "driver" else ["gateway", str(self._folder / f"{name}.toml"), "--json"]
        settings = self._settings("driver", self._near) if name == "driver" else self._places(name)
        self._actors[name] = actor = self._actor(name, ["trade_gateway", "--with-stdin", *words], settings)
        actor.read_message(UP_S)

    def _actor(self, name: str, words: Sequence[str], settings: dict[str, str]) -> JsonChild:
        return JsonChild(name, words, {**bare_environment(), **settings}, self._folder / f"{name}.complaints")

    def _places(self, name: str) -> dict[str, str]:
        """The process's own folders, in which it finds no other process of this host."""
        own = self._folder / name
        return {"TRADE_RUNTIME_DIR": str(own / "runtime"), "TRADE_STATE_DIR": str(own / "state")}

    def _settings(self, name: str, port: int) -> dict[str, str]:
        return {
            **self._places(name),
            "TRADE_SYSTEM": self._system,
            "TRADE_CREDENTIALS": self._secret,
            "TRADE_CONTAINER": name,
            "TRADE_CONNECT": f"tcp/127.0.0.1:{port}",
        }

    def _write_gateway(self, name: str, port: int, *, dials: int) -> None:
        lines = {"system": self._system, "name": name, "credentials": self._secret}
        text = "".join(f"{key} = {json.dumps(value)}\n" for key, value in lines.items()) + "insecure_lan = true\n"
        text += f'connect = ["tcp/127.0.0.1:{dials}"]\n\n'
        text += f'[network.host]\ninterface = "lo"\nlisten = ["tcp/127.0.0.1:{port}"]\n'
        (self._folder / f"{name}.toml").write_text(text, encoding="utf-8")

    def _order(self, scene: Scene, target: Target) -> Order:
        control = self._sim.control
        now = control.arm(target.name).positions_rad if target.arm else [control.device(target.name).position_rad]
        goal, speed = target.way(now[0])
        return Order(
            group=target.group,
            arm=target.arm,
            stream=scene.motion == "stream",
            from_rad=now,
            goal_rad=[goal, *now[1:]],
            speed_rad_s=speed,
            valid_s=VALID_S,
        )

    def _switch(self, bus: str, *, off: bool) -> None:
        from trade_hil_sim import BusOff  # noqa: PLC0415 - only needed here

        self._sim.control.do(BusOff(bus=bus, on=off))


@contextmanager
def standing(robot: Robot, targets: Sequence[Target], left_out: Sequence[str], folder: Path) -> Generator[Testbed]:
    """A running testbed, whose processes end with the context.

    Raises:
        ConfigurationError: there is no simulator, or it refuses this robot.
        ChildFailed: a process does not start.
    """
    try:
        from trade_hil_sim import SimProcess, SimulationError, remove_leftovers  # noqa: PLC0415 - only a drill needs it
    except ImportError:
        raise ConfigurationError(
            where="trade drill", problem="needs trade-hil-sim. Run `pip install trade-hil-sim`"
        ) from None
    remove_leftovers()
    try:
        with SimProcess(robot.where, buses=[target.bus for target in targets]) as simulated:
            stand = Testbed(robot, left_out, simulated, folder)
            try:
                stand.begin()
                yield stand
            finally:
                stand.close()
    except SimulationError as problem:
        raise ConfigurationError(where=robot.where, problem=str(problem)) from None


def _free_ports(count: int) -> list[int]:
    """Returns ports of 127.0.0.1 that are free now."""
    with ExitStack() as held:
        found = [held.enter_context(socket.socket()) for _ in range(count)]
        for each in found:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in found]
