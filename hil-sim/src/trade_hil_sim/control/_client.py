"""Steering a running simulator: a typed client of its control socket."""

import socket
import threading
from pathlib import Path
from typing import Final

import msgspec

from trade_hil_sim.control._server import Answer, State
from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.faults._methods import FaultMethods
from trade_hil_sim.mechanics._truth import ArmTruth, BusState, DeviceState, GripperTruth

__all__ = ["SimControl"]

ANSWER_S: Final = 10.0
"""How long a simulator may take over a command."""


class SimControl(FaultMethods):
    """Makes things happen in a running simulator. Threads may share one.

    Each fault and order is a method of its name, and `do` takes it as a value. In every method, `ids` are device ids
    (default: all) and `bus` is the name of a bus (default: every bus). Of a fault of answers, `instruction` is the one
    whose answers it strikes (default: any), `skip` how many of them go out unharmed first, and `count` how many it
    strikes (default: all until `heal`).

    Args:
        path: the socket, as the simulator's ready line names it.

    Raises:
        SimulationError: nobody listens there; later, whatever the simulator refuses, with what would be right.
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
        """Hang up. Idempotent; the simulator goes on."""
        self._socket.close()

    def __enter__(self) -> "SimControl":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # the truth

    def state(self) -> list[BusState]:
        """The truth about every bus and its devices."""
        return self._ask(State()).buses or []

    def device(self, which: str | int) -> DeviceState:
        """The truth about one device, by its joint's name or its id.

        Raises:
            SimulationError: no such device; names those there are. The same if an id is on two buses.
        """
        devices = [device for bus in self.state() for device in bus.devices]
        found = [device for device in devices if which in {device.joint, device.device_id}]
        if len(found) != 1:
            known = ", ".join(f"{device.joint} ({device.bus} {device.device_id})" for device in devices)
            raise SimulationError(f"{len(found)} devices are called {which!r}; there is {known}")
        return found[0]

    def gripper(self, which: str | int) -> GripperTruth:
        """The truth about one gripper, by its name or its id.

        Raises:
            SimulationError: no such gripper; names those there are. The same if an id is on two buses.
        """
        grippers = [gripper for bus in self.state() for gripper in bus.grippers]
        found = [gripper for gripper in grippers if which in {gripper.gripper, gripper.device_id}]
        if len(found) != 1:
            known = ", ".join(f"{gripper.gripper} ({gripper.bus} {gripper.device_id})" for gripper in grippers)
            raise SimulationError(f"{len(found)} grippers are called {which!r}; there is {known or 'none'}")
        return found[0]

    def arm(self, which: str) -> ArmTruth:
        """The truth about one arm, by its name.

        Raises:
            SimulationError: no such arm; names those there are.
        """
        arms = {arm.arm: arm for bus in self.state() for arm in bus.arms}
        if which not in arms:
            raise SimulationError(f"no arm is called {which!r}; there is {', '.join(arms) or 'none'}")
        return arms[which]

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
