"""Messages between the driver and its child processes, as whole frames over a pair of sockets."""

import socket
from collections.abc import Iterator
from typing import Final, Generic, TypeVar

import msgspec
from msgspec import Struct

_LONGEST: Final = 4096
Message = TypeVar("Message")


class Disconnected(Exception):
    """The other end is gone or does not read."""


class _Order(Struct, frozen=True, kw_only=True, tag=True, array_like=True):
    number: int = 0
    """Number returned in the answer; 0 for orders without one."""
    expires_ns: int = 0
    """Expiry by CLOCK_MONOTONIC, which all processes share; 0: it does not expire."""


class Heartbeat(_Order, frozen=True):
    """The driver is healthy: feed the robot's watchdog."""


class TakeControl(_Order, frozen=True):
    """Take control: upload the script, arm the watchdog."""

    watchdog_hz: float
    step_s: float
    """Time between two set-points of a stream."""


class MoveJoints(_Order, frozen=True):
    """Start a move in joint space: rad, rad/s, rad/s^2."""

    positions: list[float]
    speed: float
    accel: float


class MoveLine(_Order, frozen=True):
    """Start a move in a line: a pose, m/s, m/s^2."""

    pose: list[float]
    speed: float
    accel: float


class Servo(_Order, frozen=True):
    """One set-point of a stream, in rad."""

    positions: list[float]


class Solve(_Order, frozen=True):
    """Compute the angles for a pose of the tool, next to given ones; nothing moves."""

    pose: list[float]
    near: list[float]


class Halt(_Order, frozen=True):
    """End a move, a stream or freedrive; braking in rad/s^2."""

    decel: float


class Free(_Order, frozen=True):
    """Start freedrive."""


class Scale(_Order, frozen=True):
    """Set the speed slider."""

    fraction: float


class Ready(Struct, frozen=True, tag=True, array_like=True):
    """Ready for orders."""


class Failed(Struct, frozen=True, tag=True, array_like=True):
    """Reason of the child's end."""

    problem: str


class Done(Struct, frozen=True, tag=True, array_like=True):
    """The outcome of an order: success, or the problem."""

    number: int
    problem: str = ""
    late: bool = False
    """True if the order had expired and did not run."""
    angles: list[float] = []
    """The angles of ``Solve``; empty if there are none."""


class HeartbeatAnswer(Struct, frozen=True, tag=True, array_like=True):
    """The answer to a heartbeat."""

    running: bool
    """True while a move runs."""


class Sample(Struct, frozen=True, tag=True, array_like=True):
    """One measurement of the controller."""

    at_ns: int
    positions: list[float]
    speeds: list[float]
    pose: list[float]
    robot_mode: int
    safety_mode: int
    robot_status: int
    speed_fraction: float


Order = Heartbeat | TakeControl | MoveJoints | MoveLine | Servo | Solve | Halt | Free | Scale
Report = Ready | Failed | Done | HeartbeatAnswer | Sample


class Channel(Generic[Message]):
    """One end of the pair.

    Args:
        end: its socket.
        kind: what is received.
    """

    def __init__(self, end: socket.socket, type_: object) -> None:
        self.end = end
        self._encoder = msgspec.msgpack.Encoder()
        self._decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(type_)  # pyright: ignore[reportArgumentType]

    def send(self, message: Struct) -> None:
        """Sends a message, or raises ``Disconnected``; never waits."""
        try:
            self.end.send(self._encoder.encode(message), socket.MSG_DONTWAIT)
        except OSError as problem:
            raise Disconnected(str(problem)) from None

    def receive(self, timeout_s: float) -> Message | None:
        """Returns the next message, or None at the timeout; raises ``Disconnected``."""
        self.end.settimeout(timeout_s)
        try:
            data = self.end.recv(_LONGEST)
        except (TimeoutError, BlockingIOError):
            return None
        except OSError as problem:
            raise Disconnected(str(problem)) from None
        if not data:
            raise Disconnected("it has ended")
        return self._decoder.decode(data)

    def waiting(self) -> Iterator[Message]:
        """Yields received messages without waiting; raises ``Disconnected`` after the last."""
        while (message := self.receive(0.0)) is not None:
            yield message

    def close(self) -> None:
        """Closes the socket. Idempotent."""
        self.end.close()


def pair() -> tuple[socket.socket, socket.socket]:
    """Returns the two ends, which preserve message boundaries and detect the other's end."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
