"""A typed client of a running simulator's control socket."""

import socket
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from trade_hil_sim.control._server import Answer, State
from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.faults._methods import FaultMethods
from trade_hil_sim.mechanics._truth import ArmTruth, BusState, DeviceState, GripperTruth

_Truth = TypeVar("_Truth", DeviceState, GripperTruth, ArmTruth)
ANSWER_S: Final = 10.0
"""How long a simulator may take to carry out a command."""


class SimControl(FaultMethods):
    """Injects faults into a running simulator and carries out orders. Threads may share one.

    Each fault and order is a method of its name, and `do` takes it as a value. In every method, `ids` are device ids
    (default: all) and `bus` is the name of a bus (default: every bus). For a fault of answers, `instruction` is the one
    whose answers it affects (default: any), `skip` how many of them go out intact first, and `count` how many it
    affects (default: all until `heal`).

    Args:
        path: the socket, as the simulator's ready line names it.

    Raises:
        SimulationError: no simulator listens there; later, whenever it refuses a command, with what would be valid.
    """

    def __init__(self, path: Path | str) -> None:
        self._lock = threading.Lock()
        self._held = b""
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(ANSWER_S)
        try:
            self._socket.connect(str(path))
        except OSError as problem:
            self._socket.close()
            raise SimulationError(f"no simulator listens on {path}: {problem}") from None

    def close(self) -> None:
        """Disconnect. Idempotent; the simulator keeps running."""
        self._socket.close()

    def __enter__(self) -> "SimControl":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # the truth

    def state(self) -> list[BusState]:
        """The actual state of every bus and its devices."""
        return self._ask(State()).buses or []

    def device(self, which: str | int) -> DeviceState:
        """The actual state of one device, by its joint's name or its id.

        Raises:
            SimulationError: no such device, or an id that is on two buses; names the devices.
        """
        devices = [device for bus in self.state() for device in bus.devices]
        return _only("devices", which, [(device.joint, device) for device in devices])

    def gripper(self, which: str | int) -> GripperTruth:
        """The actual state of one gripper, by its name or its id.

        Raises:
            SimulationError: no such gripper, or an id that is on two buses; names the grippers.
        """
        grippers = [gripper for bus in self.state() for gripper in bus.grippers]
        return _only("grippers", which, [(one.gripper, one) for one in grippers])

    def arm(self, which: str) -> ArmTruth:
        """The actual state of one arm, by its name.

        Raises:
            SimulationError: no such arm; names the arms.
        """
        arms = [arm for bus in self.state() for arm in bus.arms]
        return _only("arms", which, [(arm.arm, arm) for arm in arms])

    def do(self, command: faults.Command) -> None:
        """Send any command of the simulator."""
        self._ask(command)

    def _ask(self, command: faults.Command | State) -> Answer:
        with self._lock:
            try:
                self._socket.sendall(msgspec.json.encode(command) + b"\n")
                line = self._line()
            except OSError as problem:
                raise SimulationError(f"the simulator is gone: {problem}") from None
        answer = msgspec.json.decode(line, type=Answer)
        if answer.error is not None:
            raise SimulationError(answer.error)
        return answer

    def _line(self) -> bytes:
        while b"\n" not in self._held:
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionResetError("it hung up")
            self._held += data
        line, _, self._held = self._held.partition(b"\n")
        return line


def _only(kind: str, which: str | int, named: Sequence[tuple[str, _Truth]]) -> _Truth:
    """The only one of this name or id."""
    found = [thing for name, thing in named if which in {name, thing.device_id}]
    if len(found) != 1:
        known = ", ".join(f"{name} ({thing.bus} {thing.device_id})" for name, thing in named) or "none"
        raise SimulationError(f"{len(found)} {kind} are called {which!r}; there is {known}")
    return found[0]
