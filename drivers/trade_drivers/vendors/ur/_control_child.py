"""The child process that commands: the only one that imports ``rtde_control``.

The library holds the interpreter's lock while it waits, and restores a lost connection by itself. So this process ends
when the connection or its parent process is gone, and a system alarm ends it when it is stuck.
"""

import os
import signal
import socket
import sys
import time
from contextlib import suppress
from typing import Any, Final

from trade_drivers.vendors.ur._messages import (
    Channel,
    Disconnected,
    Done,
    Free,
    Halt,
    Heartbeat,
    HeartbeatAnswer,
    MoveJoints,
    MoveLine,
    Order,
    Ready,
    Servo,
    Solve,
    TakeControl,
)

_QUIET_S: Final = 0.15
"""The time without a message after which the driver counts as interrupted, and motion stops."""
_IDLE_S: Final = 60.0
_STUCK_S: Final = 1.0
_TAKING_S: Final = 8.0
"""The library waits 5 s for its script to start."""
_LOOKAHEAD_S: Final = 0.05
_GAIN: Final = 500
_END_RAD_S2: Final = 10.0


class Child:
    """Executes orders until there is a reason to end."""

    def __init__(self, host: str, channel: "Channel[Order]") -> None:
        import rtde_control  # noqa: PLC0415 - here and nowhere else  # pyright: ignore[reportMissingTypeStubs]

        self._library: Any = rtde_control
        self._host = host
        self._channel = channel
        self._robot: Any = None
        self._streaming = self._free = False
        self._step_s = 0.0
        self._angles: list[float] = []

    def run(self) -> None:
        """Runs until the driver is gone or silent, or the connection is lost."""
        self._channel.send(Ready())
        while True:
            order = self._channel.receive(_IDLE_S if self._robot is None else _QUIET_S)
            signal.setitimer(signal.ITIMER_REAL, _TAKING_S if isinstance(order, TakeControl) else _STUCK_S)
            if order is None and self._robot is None:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
                continue
            if order is None:
                return
            if self._robot is not None and not self._robot.isConnected():
                return
            self._obey(order)
            if self._robot is None:
                signal.setitimer(signal.ITIMER_REAL, 0.0)

    def halt(self) -> None:
        """Ends the motion and the script."""
        if self._robot is not None and self._robot.isConnected():
            if self._streaming:
                self._robot.servoStop(_END_RAD_S2)
            else:
                self._robot.stopJ(_END_RAD_S2, True)
            self._robot.stopScript()

    def _obey(self, order: Order) -> None:
        if isinstance(order, Heartbeat):
            self._beat()
            return
        late = 0 < order.expires_ns <= time.monotonic_ns()
        problem = "" if late else self._carry_out(order)
        if order.number:
            angles, self._angles = self._angles, []
            self._channel.send(Done(order.number, problem, late, angles))

    def _beat(self) -> None:
        if self._robot is None:
            return
        if not self._streaming:
            self._robot.kickWatchdog()
        running = self._robot.getAsyncOperationProgressEx().isAsyncOperationRunning()
        self._channel.send(HeartbeatAnswer(running))

    def _carry_out(self, order: Order) -> str:
        """Executes an order; returns the problem, or an empty text."""
        if isinstance(order, TakeControl):
            return self._take(order)
        if self._robot is None:
            return "it has no control"
        if not isinstance(order, Halt) and not self._robot.isProgramRunning():
            return "its program does not run"
        return "" if self._command(order) else "the controller refused, or did not answer"

    def _take(self, order: TakeControl) -> str:
        try:
            self._robot = self._library.RTDEControlInterface(self._host)
        except RuntimeError as problem:
            return str(problem)
        self._step_s = order.step_s
        return "" if self._robot.setWatchdog(order.watchdog_hz) else "its watchdog could not be armed"

    def _command(self, order: Order) -> bool:
        robot = self._robot
        match order:
            case Servo():
                self._streaming = True
                return robot.servoJ(order.positions, 0.0, 0.0, self._step_s, _LOOKAHEAD_S, _GAIN)
            case MoveJoints():
                return robot.moveJ(order.positions, order.speed, order.accel, True)
            case MoveLine():
                return robot.moveL(order.pose, order.speed, order.accel, True)
            case Solve():
                if robot.getInverseKinematicsHasSolution(order.pose, order.near):
                    self._angles = robot.getInverseKinematics(order.pose, order.near)
                return True
            case Halt():
                return self._halt(order)
            case Free():
                self._free = True
                return robot.teachMode()
            case _:
                return False

    def _halt(self, order: Halt) -> bool:
        if not self._robot.isProgramRunning():
            return True
        free, self._free = self._free, False
        if free:
            return self._robot.endTeachMode()
        if self._streaming:
            self._streaming = False
            return self._robot.servoStop(order.decel)
        self._robot.stopJ(order.decel, True)
        return True


def main() -> None:
    """Serves the socket whose number is the first argument, for the controller at the second."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    child = Child(sys.argv[2], Channel(socket.socket(fileno=int(sys.argv[1])), Order))
    with suppress(Disconnected):
        child.run()
    signal.setitimer(signal.ITIMER_REAL, _STUCK_S)
    child.halt()
    os._exit(0)  # the library's own shutdown takes half a second, and may reconnect


if __name__ == "__main__":
    main()
