"""The child process that reads: it sends every new measurement, and sets the speed slider.

The library returns old values as if they were new, and its constructor waits without a timeout. So the controller's
time stamp determines a value's age, the ports are probed first, and the driver does not wait for this process.
"""

import os
import signal
import socket
import sys
import time
from contextlib import suppress
from typing import Any, Final

from trade_drivers.vendors.ur._dashboard import DashboardError, probe
from trade_drivers.vendors.ur._messages import Channel, Disconnected, Done, Failed, Order, Ready, Sample, Scale

RATE_HZ: Final = 125.0
_PROBE_S: Final = 1.0
_PROBED_S: Final = 5.0
"""Timeout of probing three ports one after the other."""
_STUCK_S: Final = 3.0
_DRIFT: Final = 0.001
"""The maximum rate difference of the clocks that does not make measurements appear older."""
_FIELDS: Final = [
    *("timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "robot_mode", "safety_mode"),
    *("robot_status_bits", "safety_status_bits", "runtime_state", "target_speed_fraction"),
]


class Age:
    """Estimates the offset of another clock from the time stamps of its measurements.

    The message with the least delay so far counts as measured on arrival. A lasting delay is forgotten at the maximum
    rate difference of the clocks: one of a second after a quarter of an hour.
    """

    def __init__(self) -> None:
        self._least_ns: int | None = None
        self._at_ns = 0

    def measured_ns(self, at_ns: int, stamp_ns: int) -> int:
        """Returns when a message was measured by our clock: it arrived at ``at_ns``, stamped ``stamp_ns``."""
        delay_ns = at_ns - stamp_ns
        if self._least_ns is None:
            self._least_ns = delay_ns
        self._least_ns = min(delay_ns, self._least_ns + int(_DRIFT * (at_ns - self._at_ns)))
        self._at_ns = at_ns
        return at_ns - (delay_ns - self._least_ns)


class Child:
    """Reads until the connection or the parent process is gone."""

    def __init__(self, host: str, channel: "Channel[Order]") -> None:
        import rtde_io  # noqa: PLC0415  # pyright: ignore[reportMissingTypeStubs]
        import rtde_receive  # noqa: PLC0415  # pyright: ignore[reportMissingTypeStubs]

        self._io_library: Any = rtde_io
        library: Any = rtde_receive
        self._robot = library.RTDEReceiveInterface(host, RATE_HZ, _FIELDS)
        self._io: Any = None
        self._host = host
        self._channel = channel
        self._clock = 0.0
        self._age = Age()

    def run(self) -> None:
        """Sends each new measurement, and executes orders in between."""
        self._channel.send(Ready())
        while self._robot.isConnected():
            signal.setitimer(signal.ITIMER_REAL, _STUCK_S)
            self._measure()
            order = self._channel.receive(1 / (2 * RATE_HZ))
            if isinstance(order, Scale):
                late = time.monotonic_ns() >= order.expires_ns
                self._channel.send(Done(order.number, "" if late else self._scale(order), late))

    def _measure(self) -> None:
        robot = self._robot
        at_ns = time.monotonic_ns()  # before the read, so that a delay makes the value older, not newer
        clock = robot.getTimestamp()
        if clock == self._clock:
            return
        self._clock = clock
        self._channel.send(
            Sample(
                self._age.measured_ns(at_ns, int(clock * 1e9)),
                robot.getActualQ(),
                robot.getActualQd(),
                robot.getActualTCPPose(),
                robot.getRobotMode(),
                robot.getSafetyMode(),
                robot.getRobotStatus(),
                robot.getTargetSpeedFraction(),
            )
        )

    def _scale(self, order: Scale) -> str:
        try:
            self._io = self._io or self._io_library.RTDEIOInterface(self._host)
        except RuntimeError as problem:
            return str(problem)
        return "" if self._io.setSpeedSlider(order.fraction) else "the controller refused"


def main() -> None:
    """Serves the socket whose number is the first argument, for the controller at the second."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    host, channel = sys.argv[2], Channel[Order](socket.socket(fileno=int(sys.argv[1])), Order)
    with suppress(Disconnected):
        try:
            signal.setitimer(signal.ITIMER_REAL, _PROBED_S)
            probe(host, _PROBE_S)
            signal.setitimer(signal.ITIMER_REAL, _STUCK_S)
            Child(host, channel).run()
        except (DashboardError, RuntimeError) as problem:
            channel.send(Failed(str(problem)))
    os._exit(0)


if __name__ == "__main__":
    main()
