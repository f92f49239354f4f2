"""The interface between a simulated wire and its clients: adapters, and the clients that they serve."""

from collections.abc import Callable
from typing import Protocol

from ._frame import Frame


class Client(Protocol):
    """A client that reaches the bus through an adapter."""

    name: str
    overrun: int
    """Frames lost in a row because it does not read."""

    def queue_frame(self, frame: Frame, wall_s: float) -> bool:
        """Deliver a frame that was on the bus at `wall_s` seconds since the epoch; False if it is lost."""
        ...

    def queue_error(self, bits: int, wall_s: float) -> bool:
        """Deliver an error of these classes (linux/can/error.h)."""
        ...


class AdapterObserver(Protocol):
    """Receives what clients do. Called from the thread that calls `Adapter.serve`."""

    def joined(self, client: Client) -> None:
        """A client may send from now on, and receives frames."""
        ...

    def left(self, client: Client) -> None:
        """A client that had joined has disconnected."""
        ...

    def submitted(self, client: Client, frame: Frame, t: float) -> None:
        """A client wants a frame sent; it was read at `t` seconds (monotonic)."""
        ...

    def misunderstood(self, client: Client, text: str) -> None:
        """A client sent something invalid."""
        ...


class Adapter(Protocol):
    """Connects clients to the bus."""

    channel: str
    """The interface clients open."""

    @property
    def port(self) -> str:
        """What a client opens: ``INTERFACE:CHANNEL``, as python-can writes it."""
        ...

    @property
    def plugged(self) -> bool:
        """Whether the bus can be reached."""
        ...

    def open(self) -> None:
        """Accept clients; raises SimulationError if there is no such interface."""
        ...

    def plug_in(self) -> None:
        """Accept clients again."""
        ...

    def unplug(self) -> None:
        """Disconnect all clients."""
        ...

    def close(self) -> None:
        """Unplug, for good."""
        ...

    def serve(self, wake_read: int, wait_s: float, awake: Callable[[float], None]) -> bool:
        """Wait for clients, a wake-up or the end of the wait, then do what clients want.

        Args:
            wake_read: a file descriptor that ends the wait.
            wait_s: how long to wait, in seconds.
            awake: called with the time, in seconds (monotonic), before anything of a client is carried out.

        Returns:
            Whether it was woken.
        """
        ...

    def flush(self) -> None:
        """Write to clients what they can take."""
        ...
