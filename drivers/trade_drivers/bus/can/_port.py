"""One end of a CAN bus through python-can; all its failures become ``PortLost``."""

import logging
import os
import socket
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import can

from trade.errors import ConfigurationError
from trade_drivers.bus._can_monitor import CanBusState
from trade_drivers.bus._host_lock import HostLock, Taken
from trade_drivers.bus._jobs import PortLost, losing
from trade_drivers.bus.can._bus_load import LoadMeter, frame_bits
from trade_drivers.bus.can._errors import ErrorState, error_state, unheard
from trade_drivers.bus.can._netlink import look_at
from trade_drivers.bus.can._send_queue import LONGEST_S, SendQueue, is_full
from trade_drivers.bus.can._sniffer import FramesById
from trade_drivers.bus.can._socketcand import ServerBus
from trade_robotfile import CanBus

_log = logging.getLogger("trade")
logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)  # else it warns of each split frame
_HELLO_S: Final = 1.0
_SOCKETCAND_PORT: Final = 29536
_HELLO: Final = b"< hi >"
_TROUBLE: Final = (can.CanError, OSError, ValueError, IndexError)
"""The errors that python-can's interfaces raise; not only its own."""
_FULL: Final = 0.9
_SLICE_S: Final = 0.01
_SLOWEST_S: Final = 0.8
"""Each running driver of this project sends a frame within this time: the longest cycle is 0.67 s."""


class Frame(NamedTuple):
    """A data frame."""

    id: int
    data: bytes


def split_port(port: str, where: str) -> tuple[str, str]:
    """Splits a text such as ``socketcan:can0`` into interface and channel.

    Raises:
        ConfigurationError: the text has another form.
    """
    interface, colon, channel = port.partition(":")
    if not (interface and colon and channel):
        problem = f"{port!r} is not a CAN bus; write INTERFACE:CHANNEL, such as socketcan:can0"
        raise ConfigurationError(where=where, problem=problem)
    return interface, channel


def _no_orders(_: FramesById) -> Collection[int]:
    """Accepts any traffic."""
    return ()


class CanPort:
    """A CAN bus for one thread, with a lock against other drivers on this host.

    Args:
        path: ``INTERFACE:CHANNEL``.
        bitrate: bits per second.
        where: the bus's table in the robot file, for messages; empty if it has none.
        listen_s: how long to listen after each opening before anything may be sent.
        orders: returns the identifiers of that traffic that only another driver sends.
        patience_s: how long to wait for room in a full send queue, at most 40 ms.
    """

    def __init__(
        self,
        path: str,
        bitrate: int,
        where: str = "bus",
        listen_s: float = 0.0,
        orders: Callable[[FramesById], Collection[int]] = _no_orders,
        patience_s: float = LONGEST_S,
    ) -> None:
        self.path = path
        self.state = ErrorState.ACTIVE
        self.errors = 0
        """Total number of error frames received."""
        self.bus_offs = 0
        """Number of bus-offs."""
        self.sniffed = FramesById({})
        """The traffic heard at the last opening."""
        self._where = where
        self._listen_s, self._orders = listen_s, orders
        self._interface, self._channel = split_port(path, where or path)
        device = self._channel.partition("@")[0] if self._channel.startswith("/") else ""
        self.queue = SendQueue(self._interface, self._channel, patience_s)
        self.unheard = False
        """Nothing has acknowledged a frame since the last one was received."""
        self._lock = HostLock(self._known_as(), where or "a scan", device)
        self._bitrate = bitrate
        self._bus: can.BusABC | None = None
        self.meter = LoadMeter(bitrate, time.monotonic_ns())
        self._was_full = False

    @classmethod
    def of(cls, path: str, bus: CanBus, where: str, orders: Callable[[FramesById], Collection[int]]) -> "CanPort":
        """Returns a port for a driver: it listens for as long as watchdogs take.

        A device that has torque after that is fed by another driver, or has no watchdog.
        """
        return cls(path, bus.bitrate, where, max(_SLOWEST_S, bus.watchdog_s + 0.1), orders, 1 / bus.rate_hz)

    def _known_as(self) -> str:
        """Returns the name of this bus for all processes on this host."""
        match self._interface:
            case "virtual":  # private to each process
                return f"{self.path} of {os.getpid()}"
            case _ if self._channel.startswith("/"):
                return f"{self._interface}:{os.path.realpath(self._channel)}"
            case _:
                return self.path

    def open(self) -> None:
        """Opens the bus after listening for other drivers. Sends nothing.

        Raises:
            PortLost: the bus is not present.
            ConfigurationError: another driver has the bus, on this host or elsewhere; or python-can does not know the
                interface, or needs another package for it.
        """
        self.close()
        try:
            self._lock.take()
            self._begin()
            self._listen()
        except Taken as taken:
            problem = f"{self.path}: another driver has this bus: {taken}; stop it first"
            raise self._wrong("channel", problem) from None
        except BaseException:
            self.close()
            raise

    def _begin(self) -> None:
        options = self._options()
        if self.state is not ErrorState.BUS_OFF:  # only a frame or the system shows the end of bus-off
            self.state = ErrorState.ACTIVE
        if self._interface == "socketcan":
            self._verify_interface()
        with losing(*_TROUBLE):
            try:
                if self._interface == "socketcand":
                    self._bus = ServerBus(**options)
                else:
                    self._bus = can.Bus(interface=self._interface, **options)
            except (can.CanInterfaceNotImplementedError, ImportError) as unknown:
                raise self._wrong("interface", f"{self.path}: {unknown}") from None

    def _listen(self) -> None:
        heard: dict[int, list[bytes]] = {}
        until = time.monotonic() + self._listen_s
        while (left_s := until - time.monotonic()) > 0:
            frame = self.receive(min(left_s, _SLICE_S))
            if frame is not None:
                heard.setdefault(frame.id, []).append(frame.data)
        self.sniffed = FramesById(heard)
        if orders := self._orders(self.sniffed):
            ids = ", ".join(f"{one:03X}h" for one in sorted(orders))
            problem = f"{self.path}: another driver commands the devices of this bus (it sends {ids}); stop it first"
            raise self._wrong("channel", problem)

    def _verify_interface(self) -> None:
        """Checks the state of the interface in the system.

        Raises:
            PortLost: the interface does not exist, is down, or its controller is bus-off.
        """
        with losing(OSError):
            link = look_at(self._channel)
        if not link.up:
            raise PortLost(f"it is down; `ip link set {self._channel} up`")
        if link.state is not None:
            self._enter(link.state)

    def look(self, name: str) -> CanBusState:
        """Returns the current state; callable from any thread."""
        return CanBusState(
            name=name,
            port=self.path,
            up=self._bus is not None,
            state=self.state.word,
            load=self.meter.load,
            error_frames=self.errors,
            bus_offs=self.bus_offs,
        )

    @property
    def doubt(self) -> str:
        """What the controller says about frames without an answer; empty if nothing."""
        if self.unheard or self.state >= ErrorState.PASSIVE:
            return f"the bus is {self.state.word}: nothing acknowledges frames, or something disturbs them"
        return ""

    def _options(self) -> dict[str, Any]:
        match self._interface:
            case "socketcand":
                host, port, channel = self._server()
                _greet(host, port)
                # without tcp_tune several small frames in a row wait 40 ms for an acknowledgement
                return {"host": host, "port": port, "channel": channel, "tcp_tune": True}
            case "slcan":
                return {"channel": self._channel, "bitrate": self._bitrate, "sleep_after_open": 0}
            case "socketcan" | "virtual":  # socketcan's bit rate is set by the system, virtual has none
                return {"channel": self._channel}
            case _:
                return {"channel": self._channel, "bitrate": self._bitrate}

    def _wrong(self, key: str, problem: str) -> ConfigurationError:
        return ConfigurationError(where=f"{self._where}.{key}" if self._where else "", problem=problem)

    def _server(self) -> tuple[str, int, str]:
        server, slash, channel = self._channel.partition("/")
        host, _, port = server.partition(":")
        if not (host and slash and channel) or (port and not port.isdecimal()):
            problem = f"{self._channel!r}: write HOST:PORT/CHANNEL, such as 127.0.0.1:29536/can0"
            raise self._wrong("channel", problem)
        return host, int(port or _SOCKETCAND_PORT), channel

    def close(self) -> None:
        """Closes the bus. Idempotent."""
        bus, self._bus = self._bus, None
        self.meter = LoadMeter(self._bitrate, time.monotonic_ns())
        if bus is not None:
            with suppress(*_TROUBLE):
                bus.shutdown()
        self._lock.release()

    def send(self, frame_id: int, data: bytes) -> None:
        """Sends one frame.

        Raises:
            PortFull, PortLost: the frame could not be sent.
        """
        self.send_all([Frame(frame_id, data)])

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Sends frames in this order, in one write if the interface supports that.

        Waits only for room in a full send queue, for a cycle at most.

        Raises:
            PortFull, PortLost: not all frames could be sent.
        """
        messages = [can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False) for frame in frames]
        bus = self._open_bus()
        try:
            if isinstance(bus, ServerBus):
                bus.send_all(messages)
            else:
                for message in messages:
                    self._put(bus, message)
        except _TROUBLE as gone:
            raise PortLost(str(gone)) from None
        self._count(sum(frame_bits(len(frame.data)) for frame in frames))

    def _put(self, bus: can.BusABC, message: can.Message) -> None:
        waited = False
        while True:
            try:
                bus.send(message, timeout=0)
            except can.CanOperationError as refused:
                if not is_full(refused):
                    raise
                waited = True
                self.queue.await_room(unheard=self.unheard)
            else:
                if not waited:
                    self.queue.renew()
                return

    def receive(self, timeout_s: float) -> Frame | None:
        """Returns a data frame, or None if none arrives in time or an error frame does.

        Raises:
            PortLost: the bus is gone, or this end is bus-off.
        """
        bus = self._open_bus()
        try:
            message, _ = bus._recv_internal(timeout_s)  # `recv` waits on when the wall clock is set back meanwhile
        except _TROUBLE as gone:
            raise PortLost(str(gone)) from None
        if message is None:
            self.meter.tick(time.monotonic_ns())
            return None
        if message.is_error_frame:
            self._take_error(message.arbitration_id, bytes(message.data))
            return None
        if self.state is ErrorState.BUS_OFF:
            self._enter(ErrorState.ACTIVE)  # nothing is received in bus-off
        self.unheard = False
        self._count(frame_bits(len(message.data)))
        if message.is_extended_id or message.is_remote_frame:
            return None
        return Frame(message.arbitration_id, bytes(message.data))

    def _open_bus(self) -> can.BusABC:
        if self._bus is None:
            raise PortLost("it is not open")
        return self._bus

    def _count(self, bits: int) -> None:
        self.meter.add(bits, time.monotonic_ns())
        full = self.meter.load > _FULL
        if full and not self._was_full:
            _log.warning(
                "%s: the bus is %.0f %% full; lower rate_hz or raise the bit rate", self.path, self.meter.load * 100
            )
        self._was_full = full

    def _take_error(self, frame_id: int, data: bytes) -> None:
        self.errors += 1
        self.unheard = self.unheard or unheard(frame_id)
        state = error_state(frame_id, data)
        if state is not None:
            self._enter(state)

    def _enter(self, state: ErrorState) -> None:
        """Records the state of the controller; raises PortLost for bus-off."""
        before, self.state = self.state, state
        if state != before:
            _log.log(logging.INFO if state < before else logging.WARNING, "%s: the bus is %s", self.path, state.word)
        if state is ErrorState.BUS_OFF:
            self.bus_offs += state != before
            raise PortLost(self._bus_off())

    def _bus_off(self) -> str:
        remedy = "check bit rate, termination and cable"
        if self._interface == "socketcan":
            here = self._channel
            remedy += f", then `ip link set {here} down` and `up`; with `ip link set {here} type can restart-ms 100` "
            remedy += "it comes back by itself"
        return f"bus-off: too many errors on the bus; {remedy}"


def _greet(host: str, port: int) -> None:
    """Checks with a timeout whether a server answers, as python-can's client has no timeout."""
    try:
        with socket.create_connection((host, port), _HELLO_S) as probe:
            if not probe.recv(len(_HELLO)).startswith(b"<"):
                raise PortLost(f"{host}:{port} is not a socketcand server")
    except OSError as bad:
        raise PortLost(f"{host}:{port}: {bad}") from None
