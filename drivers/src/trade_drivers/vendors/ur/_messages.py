"""What the driver and its child processes say to each other: frames over a pair of sockets, whole or not at all."""

import socket
from collections.abc import Iterator
from typing import Final, Generic, TypeVar

import msgspec
from msgspec import Struct

__all__ = [
    "Beat",
    "Channel",
    "Done",
    "Failed",
    "Free",
    "Gone",
    "Halt",
    "Hello",
    "MoveJoints",
    "MoveLine",
    "Order",
    "Pulse",
    "Report",
    "Sample",
    "Scale",
    "Servo",
    "Solve",
    "Take",
    "pair",
]

_LONGEST: Final = 4096
Message = TypeVar("Message")


class Gone(Exception):
    """The other end is gone, or does not read."""


class _Order(Struct, frozen=True, kw_only=True, tag=True, array_like=True):
    number: int = 0
    """Given back in the answer; 0: there is none."""
    expires_ns: int = 0
    """By CLOCK_MONOTONIC, which is one for all processes; later it is not carried out. 0: it does not expire."""


class Beat(_Order, frozen=True):
    """The driver is well: feed the robot's watchdog."""


class Take(_Order, frozen=True):
    """Take control: upload the script, arm the watchdog."""

    watchdog_hz: float
    step_s: float
    """From one set-point of a stream to the next."""


class MoveJoints(_Order, frozen=True):
    """Begin a move in joint space: rad, rad/s, rad/s^2."""

    positions: list[float]
    speed: float
    accel: float


class MoveLine(_Order, frozen=True):
    """Begin a move in a line: a pose, m/s, m/s^2."""

    pose: list[float]
    speed: float
    accel: float


class Servo(_Order, frozen=True):
    """One set-point of a stream, in rad."""

    positions: list[float]


class Solve(_Order, frozen=True):
    """Ask for the angles that bring the tool to a pose, those next to given ones; nothing moves."""

    pose: list[float]
    near: list[float]


class Halt(_Order, frozen=True):
    """End whatever it does: a move, a stream, freedrive; braking in rad/s^2."""

    decel: float


class Free(_Order, frozen=True):
    """Let the arm be moved by hand."""


class Scale(_Order, frozen=True):
    """Set the speed slider."""

    fraction: float


class Hello(Struct, frozen=True, tag=True, array_like=True):
    """Ready for orders."""


class Failed(Struct, frozen=True, tag=True, array_like=True):
    """Why it ends."""

    problem: str


class Done(Struct, frozen=True, tag=True, array_like=True):
    """An order was carried out, or why it was not."""

    number: int
    problem: str = ""
    late: bool = False
    """It had expired, so it was not."""
    angles: list[float] = []
    """What ``Solve`` found; empty: there are none."""


class Pulse(Struct, frozen=True, tag=True, array_like=True):
    """The answer to a beat."""

    running: bool
    """A move it began is under way."""


class Sample(Struct, frozen=True, tag=True, array_like=True):
    """One measurement of the controller, as it arrived."""

    at_ns: int
    positions: list[float]
    speeds: list[float]
    pose: list[float]
    robot_mode: int
    safety_mode: int
    robot_status: int
    speed_fraction: float


Order = Beat | Take | MoveJoints | MoveLine | Servo | Solve | Halt | Free | Scale
Report = Hello | Failed | Done | Pulse | Sample


class Channel(Generic[Message]):
    """One end of the pair.

    Args:
        end: its socket.
        kind: what is received.
    """

    def __init__(self, end: socket.socket, kind: object) -> None:
        self.end = end
        self._encoder = msgspec.msgpack.Encoder()
        self._decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(kind)  # pyright: ignore[reportArgumentType]

    def send(self, message: Struct) -> None:
        """Say something, or raise ``Gone``; it never waits."""
        try:
            self.end.send(self._encoder.encode(message), socket.MSG_DONTWAIT)
        except OSError as problem:
            raise Gone(str(problem)) from None

    def receive(self, timeout_s: float) -> Message | None:
        """The next word, or None when there was none for so long; raises ``Gone``."""
        self.end.settimeout(timeout_s)
        try:
            data = self.end.recv(_LONGEST)
        except (TimeoutError, BlockingIOError):
            return None
        except OSError as problem:
            raise Gone(str(problem)) from None
        if not data:
            raise Gone("it has ended")
        return self._decoder.decode(data)

    def waiting(self) -> Iterator[Message]:
        """What has come, without waiting; raises ``Gone`` after the last."""
        while (message := self.receive(0.0)) is not None:
            yield message

    def close(self) -> None:
        """Let go of it; more than once is fine."""
        self.end.close()


def pair() -> tuple[socket.socket, socket.socket]:
    """The two ends: what is sent arrives in one piece, and the end of one is noticed by the other."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
