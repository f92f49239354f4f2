"""The control socket: one line of JSON in, one out. It receives faults while a robot is simulated.

It accepts every `Command`, and ``{"do": "state"}``. Answers are ``{"ok": true}``, with ``"buses"`` for a
state, or ``{"error": "..."}``.
"""

import os
import selectors
import socket
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from trade_hil_sim.faults._commands import Command, SimulationError, kinds_of
from trade_hil_sim.mechanics._truth import BusState

if TYPE_CHECKING:
    from trade_hil_sim.robot._robot import SimulatedBus

LONGEST_LINE: Final = 65_536
LONGEST_PATH: Final = 100
"""Unix socket paths end at 108 bytes on Linux and sooner elsewhere."""
_UNREADABLE: Final = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


class State(msgspec.Struct, frozen=True, tag_field="do", tag="state", forbid_unknown_fields=True):
    """Ask for the truth about all devices."""


class _CommandName(msgspec.Struct):
    do: str


class Answer(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of answer."""

    ok: bool = False
    error: str | None = None
    buses: list[BusState] | None = None


class ControlServer:
    """Listens on a Unix socket and controls buses. One thread serves all clients.

    Args:
        path: the socket; made by `open`, removed by `close`.
        buses: to control.
    """

    def __init__(self, path: Path, buses: "Sequence[SimulatedBus]") -> None:
        self.path = path
        self._buses = {bus.name: bus for bus in buses}
        self._decoder: msgspec.json.Decoder[Command | State] = msgspec.json.Decoder(Command | State)  # pyright: ignore[reportArgumentType]
        self._thread: threading.Thread | None = None
        self._closing = False

    def open(self) -> "ControlServer":
        """Start to listen."""
        if len(os.fsencode(self.path)) > LONGEST_PATH:
            raise SimulationError(f"{self.path} is too long for a socket; give a shorter path, such as /tmp/sim.sock")
        self._listener = _listen(self.path)
        self._wake_read, self._wake_write = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name="sim-control", daemon=True)
        self._thread.start()
        return self

    def close(self) -> None:
        """Disconnect all clients and remove the socket. Idempotent."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._closing = True
        with suppress(BrokenPipeError):  # a client that hung up has woken it, and it has ended
            self._wake_write.send(b"!")
        thread.join(5.0)
        self._wake_write.close()

    def __enter__(self) -> "ControlServer":
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def answer(self, line: bytes) -> Answer:
        """The answer to one line of command."""
        try:
            command = self._decoder.decode(line)
            if isinstance(command, State):
                return Answer(ok=True, buses=[bus.state() for bus in self._buses.values()])
            for bus, meant in self._meant(command):
                bus.do(meant)
        except _UNREADABLE as problem:
            return Answer(error=_explain(problem, line))
        except (SimulationError, OSError) as problem:
            return Answer(error=str(problem))
        return Answer(ok=True)

    def _meant(self, command: Command) -> "list[tuple[SimulatedBus, Command]]":
        """The command for each bus; without a bus's name, each bus gets the ids that it has."""
        ids: tuple[int, ...] | None = getattr(command, "ids", None)
        if command.bus is not None:
            if command.bus not in self._buses:
                raise SimulationError(f"there is no bus {command.bus!r}; there is {', '.join(self._buses)}")
            return [(self._buses[command.bus], command)]
        if ids is None or len(self._buses) == 1:
            return [(bus, command) for bus in self._buses.values()]
        return self._by_bus(command, ids)

    def _by_bus(self, command: Command, ids: tuple[int, ...]) -> "list[tuple[SimulatedBus, Command]]":
        states = {name: bus.state() for name, bus in self._buses.items()}
        here = {name: {device.device_id for device in (*s.devices, *s.grippers, *s.arms)} for name, s in states.items()}
        if unknown := set(ids).difference(*here.values()):
            known = ", ".join(f"{sorted(there)} on {name}" for name, there in here.items())
            raise SimulationError(f"no bus has a device {sorted(unknown)}; there is {known}")
        mine = {name: tuple(i for i in ids if i in there) for name, there in here.items()}
        return [(self._buses[name], replace(command, ids=some)) for name, some in mine.items() if some]

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_read, selectors.EVENT_READ)
            selector.register(self._listener, selectors.EVENT_READ, lambda: self._accept(selector))
            try:
                while not self._closing:
                    for key, _ in selector.select():
                        if key.data is not None:
                            key.data()
            finally:
                for key in list(selector.get_map().values()):
                    _close(key.fileobj)
                with suppress(FileNotFoundError):
                    self.path.unlink()

    def _accept(self, selector: selectors.BaseSelector) -> None:
        with suppress(OSError):
            client, _ = self._listener.accept()
            client.settimeout(1.0)
            held = bytearray()
            selector.register(client, selectors.EVENT_READ, lambda: self._serve(selector, client, held))

    def _serve(self, selector: selectors.BaseSelector, client: socket.socket, held: bytearray) -> None:
        try:
            data = client.recv(LONGEST_LINE)
            held += data
            while b"\n" in held:
                line, _, rest = bytes(held).partition(b"\n")
                held[:] = rest
                client.sendall(msgspec.json.encode(self.answer(line)) + b"\n")
            gone = not data or len(held) > LONGEST_LINE
        except OSError:
            gone = True
        if gone:
            selector.unregister(client)
            client.close()


def _close(thing: object) -> None:
    closer: Callable[[], None] | None = getattr(thing, "close", None)
    if closer is not None:
        closer()


def _listen(path: Path) -> socket.socket:
    _remove_stale(path)
    listener = socket.socket(socket.AF_UNIX)
    try:
        listener.bind(str(path))
        listener.listen()
    except OSError as problem:
        listener.close()
        raise SimulationError(f"cannot listen on {path}: {problem}; is another simulator using it?") from None
    listener.setblocking(False)
    return listener


def _remove_stale(path: Path) -> None:
    """Remove the socket of a simulator that was killed, but not that of a running one."""
    if path.is_socket():
        with socket.socket(socket.AF_UNIX) as probe:
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:
                path.unlink()


def _explain(problem: Exception, line: bytes) -> str:
    text, kinds = str(problem), {"state": State, **kinds_of(Command)}
    if "$.do" in text or "`do`" in text:
        return f"{text}; do is one of {', '.join(kinds)}"
    with suppress(*_UNREADABLE, KeyError):
        kind = kinds[msgspec.json.decode(line, type=_CommandName).do]
        return f"{text}; its keys are do, {', '.join(kind.__struct_fields__)}"
    return f'{text}; a command is one line such as {{"do": "mute", "ids": [1]}}'
