"""The adapter: a TCP port that speaks to clients as socketcand does. It handles text and sockets, not the wire."""

import socket
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final

from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.robot._bus_thread import ready

from ._adapter import AdapterObserver
from ._frame import Frame
from ._text import GREETING, OK, Reader, error_text, frame_text, parse_send, refusal

LOOPBACK: Final = "127.0.0.1"
SETTLE_S: Final = 0.05
"""A client expects the last word of the greeting alone in its segment: frames wait this long, or for its first."""
SEND_BUFFER: Final = 32_768
"""Bytes that the system buffers for a client: small, so that a driver that was frozen finds few old frames."""
MOST_UNSENT: Final = 65_536
"""Bytes kept for a client that does not read; later ones are lost, as in a full receive buffer."""


class HubClient:
    """One connection. It is opened, then put in raw mode, then it sends and receives frames."""

    def __init__(self, connection: socket.socket, number: int) -> None:
        self.name = f"client{number}"
        self.connection = connection
        self.raw = False
        self.opened = False
        self.reader = Reader()
        self.quiet_until = 0.0
        self.unsent = bytearray()
        self.overrun = 0
        """Texts lost in a row because it does not read."""

    def fileno(self) -> int:
        """For select."""
        return self.connection.fileno()

    def queue(self, text: bytes) -> bool:
        """Queue text; False if it is lost."""
        if len(self.unsent) > MOST_UNSENT:
            self.overrun += 1
            return False
        self.overrun = 0
        self.unsent += text
        return True

    def queue_frame(self, frame: Frame, wall_s: float) -> bool:
        """Queue a frame for the client; False if it is lost."""
        return self.queue(frame_text(frame, wall_s))

    def queue_error(self, bits: int, wall_s: float) -> bool:
        """Queue an error for the client."""
        return self.queue(error_text(bits, wall_s))

    def flush(self) -> None:
        """Write what can be written without waiting; raises OSError when it is gone."""
        if self.unsent and time.monotonic() >= self.quiet_until:
            with suppress(BlockingIOError):
                del self.unsent[: self.connection.send(self.unsent)]

    def send_greeting(self, text: bytes) -> None:
        """Write a word of the greeting, in a segment of its own."""
        with suppress(BlockingIOError):
            self.connection.send(text)


class Hub:
    """Listens on a loopback port of its own and speaks with several clients.

    Args:
        channel: the one interface clients can open.
        observer: receives what they do.
    """

    def __init__(self, channel: str, observer: AdapterObserver) -> None:
        self.channel = channel
        self._observer = observer
        self._holder: socket.socket | None = None
        self._listener: socket.socket | None = None
        self._clients: list[HubClient] = []
        self._count = 0

    @property
    def tcp_port(self) -> int:
        """The port; 0 before `open`."""
        return 0 if self._holder is None else int(self._holder.getsockname()[1])

    @property
    def port(self) -> str:
        """What a client opens: ``socketcand:127.0.0.1:29536/can0``."""
        return f"socketcand:{LOOPBACK}:{self.tcp_port}/{self.channel}"

    @property
    def plugged(self) -> bool:
        """Whether clients can connect."""
        return self._listener is not None

    @property
    def clients(self) -> Iterable[HubClient]:
        """Clients in raw mode."""
        return tuple(client for client in self._clients if client.raw)

    def open(self) -> None:
        """Take a port and listen on it."""
        # bound but never listening, it reserves the port number while the adapter is unplugged
        self._holder = _bound(0)
        self.plug_in()

    def plug_in(self) -> None:
        """Listen."""
        if self._listener is None:
            self._listener = _bound(self.tcp_port)
            self._listener.listen()

    def unplug(self) -> None:
        """Refuse connections and disconnect all clients."""
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()
        for client in tuple(self._clients):
            self._drop(client)

    def close(self) -> None:
        """Unplug and free the port."""
        self.unplug()
        if self._holder is not None:
            self._holder.close()

    def serve(self, wake_read: int, wait_s: float, awake: Callable[[float], None]) -> bool:
        """Wait for clients, a wake-up or the end of the wait, then do what clients want; see `Adapter`."""
        watched: list[int | HubClient | socket.socket] = [wake_read, *self._clients]
        if self._listener is not None:
            watched.append(self._listener)
        writing = [client for client in self._clients if client.unsent]
        now = time.monotonic()
        held_s = min((c.quiet_until - now for c in writing if c.quiet_until > now), default=wait_s)
        writing = [client for client in writing if client.quiet_until <= now]
        readable = ready(watched, writing, max(0.0, min(wait_s, held_s)))
        t = time.monotonic()
        awake(t)
        for thing in readable:
            if thing is self._listener:
                self._accept()
            elif isinstance(thing, HubClient):
                self._read(thing, t)
        return wake_read in readable

    def flush(self) -> None:
        """Write to clients what they can take."""
        for client in tuple(self._clients):
            try:
                client.flush()
            except OSError:
                self._drop(client)

    def _accept(self) -> None:
        if self._listener is None:
            return
        with suppress(OSError):
            connection, _ = self._listener.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            self._count += 1
            client = HubClient(connection, self._count)
            self._clients.append(client)
            client.send_greeting(GREETING)

    def _read(self, client: HubClient, t: float) -> None:
        if client not in self._clients:
            return
        try:
            data = client.connection.recv(65536)
            if data:
                client.quiet_until = 0.0
                for words in client.reader.feed(data):
                    self._obey(client, words, t)
                return
        except BlockingIOError:
            return
        except OSError:
            pass
        self._drop(client)

    def _obey(self, client: HubClient, words: list[str], t: float) -> None:
        match words:
            case ["open", channel] if not client.opened:
                client.opened = channel == self.channel
                client.send_greeting(OK if client.opened else refusal(f"could not open bus {channel}"))
            case ["rawmode"] if client.opened and not client.raw:
                client.raw, client.quiet_until = True, t + SETTLE_S
                client.send_greeting(OK)
                self._observer.joined(client)
            case ["send", *rest] if client.raw:
                self._send(client, rest, t)
            case _:
                self._observer.misunderstood(client, " ".join(words))
                client.queue(refusal("unknown command"))

    def _send(self, client: HubClient, words: list[str], t: float) -> None:
        try:
            frame = parse_send(words)
        except SimulationError as problem:
            self._observer.misunderstood(client, str(problem))
        else:
            self._observer.submitted(client, frame, t)

    def _drop(self, client: HubClient) -> None:
        if client in self._clients:
            self._clients.remove(client)
            client.connection.close()
            if client.raw:
                self._observer.left(client)


def _bound(number: int) -> socket.socket:
    made = socket.socket()
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        made.bind((LOOPBACK, number))
        made.setblocking(False)
    except OSError:
        made.close()
        raise
    return made
