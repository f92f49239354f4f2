"""A simulated CAN bus: devices on a wire that several clients reach through one adapter, with a log and faults."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import inf
from operator import attrgetter
from typing import Final

import msgspec

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._answer_faults import ActiveFaults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog, LogEntry
from trade_hil_sim.mechanics._truth import BusState
from trade_hil_sim.robot._bus_thread import BusThread

from ._adapter import Adapter, Client
from ._device import Device
from ._frame import Frame
from ._hub import Hub
from ._interface import Interface
from ._wire import Station, Wire

ANSWER_S: Final = 5.0
"""How long the bus's thread may take to carry out an order."""
MOST_DATA: Final = 8
BUS_ERROR: Final = 0x88
"""A protocol violation and a bus error (linux/can/error.h)."""
BUS_OFF: Final = 0x40
RESTARTED: Final = 0x100

_DUE: Final = attrgetter("due")


class CanBus(BusThread):
    """Devices on one CAN bus; clients reach it at `port`: by the socketcand protocol, or on an interface of the system.

    Args:
        devices: on the bus.
        name: of the bus, in the log.
        channel: the interface clients open.
        bitrate: bits a second, if paced.
        log: where to record; default: a log in memory, at `log`.
        paced: let frames take as long as on a real wire; else none takes time.
        interface: a ``vcan`` of the system that the devices sit on, instead of a server of their own.
    """

    @staticmethod
    def label(frame: Frame) -> tuple[str, int | None]:  # noqa: ARG004 - without a protocol there is nothing to tell
        """What a frame is, for the log and for faults: its name, and the id of the device it comes from or goes to."""
        return "", None

    def __init__(
        self,
        devices: Iterable[Device] = (),
        *,
        name: str = "bus",
        channel: str = "can0",
        bitrate: int = 1_000_000,
        log: ByteLog | None = None,
        paced: bool = True,
        interface: str = "",
    ) -> None:
        super().__init__(name, ANSWER_S)
        self.log = ByteLog() if log is None else log
        self._devices = list(devices)
        self._faults = ActiveFaults()
        self._echo = False
        self._adapter_off = False
        self._wire = Wire(bitrate if paced else None, self)
        self._adapter: Adapter = Interface(interface, self) if interface else Hub(channel, self)
        self._wall_offset_s = time.time() - time.monotonic()
        self._clients: dict[Client, Station] = {}
        self._stations = {device.device_id: self._attach(device) for device in self._devices}

    def _attach(self, device: Device) -> Station:
        station = Station(device.joint or f"node {device.device_id}", device.hear, device.device_id)
        device.send = lambda frame, t: self._post(station, frame, t)
        device.emit = lambda entry: self.log.add(msgspec.structs.replace(entry, bus=self.name))
        self._wire.attach(station)
        return station

    # for any thread

    @property
    def port(self) -> str:
        """What a client opens: ``socketcand:127.0.0.1:29536/can0``, or ``socketcan:vcan0``; known from `open` on."""
        return self._adapter.port

    @property
    def channel(self) -> str:
        """The interface clients open."""
        return self._adapter.channel

    @property
    def devices(self) -> Sequence[Device]:
        """The devices. The bus's own thread uses them, too."""
        return tuple(self._devices)

    def state(self) -> BusState:
        """The actual state of the bus and its devices, now."""
        return self._in_thread(self._state)

    def do(self, command: faults.Command) -> None:
        """Carry out one fault or order; raises `SimulationError` if the bus lacks the device."""
        self._in_thread(lambda: self._do(command))

    def load(self) -> tuple[float, float]:
        """The total time that frames held the wire, and the time now, both in seconds: two samples give the load."""
        return self._in_thread(lambda: (self._wire.busy_s, time.monotonic()))

    # the thread

    def _begin(self) -> None:
        self._adapter.open()

    def _step(self) -> None:
        if self._adapter.serve(self._errands.wake_read, self._patience_s(), self._pass_time):
            self._errands.run()
        self._pass_time(time.monotonic())
        self._adapter.flush()

    def _end(self) -> None:
        self._adapter.close()

    def _patience_s(self) -> float:
        due = min((device.due for device in self._devices), default=inf)
        return min(60.0, max(0.0, min(due, self._wire.next_due()) - time.monotonic()))

    def _pass_time(self, now: float) -> None:
        """Run what is due on the wire and in devices, in order, each at its own time."""
        while True:
            device = min(self._devices, key=_DUE, default=None)
            own, wire = inf if device is None else device.due, self._wire.next_due()
            if min(own, wire) > now:
                return
            if device is not None and own <= wire:
                device.advance(own)
            else:
                self._wire.advance(wire)

    # faults and orders

    def _state(self) -> BusState:
        t = time.monotonic()
        self._pass_time(t)
        devices = [
            msgspec.structs.replace(d.state(t), bus=self.name, absent=not self._stations[d.device_id].connected)
            for d in self._devices
        ]
        return BusState(name=self.name, port=self.port, plugged=self._adapter.plugged, devices=devices)

    def _do(self, command: faults.Command) -> None:
        t = time.monotonic()
        self._pass_time(t)
        match command:
            case faults.Unplug():
                self._adapter.unplug()
                self._note("unplugged", t)
            case faults.Replug():
                self._adapter.plug_in()
                self._note("plugged", t)
            case faults.Echo():
                self._echo = command.on
            case faults.Heal():
                self._heal(t)
            case faults.Dribble():
                raise SimulationError("a frame comes whole; late, truncate or garbage suit a CAN bus")
            case faults.AnswerFault():
                self._named(command.ids)
                self._faults.add(command)
            case faults.Unmute():
                self._named(command.ids)
                self._faults.unmute(command.ids)
            case faults.Absent(nth=int()):
                raise SimulationError(f"nodes of bus {self.name} have ids of their own; name them by ids, not by nth")
            case faults.BusOff(ids=None):
                self._switch_adapter(command.on, t)
            case _:
                self._do_to_devices(command, t)

    def _do_to_devices(self, command: faults.Command, t: float) -> None:
        for device in self._named(getattr(command, "ids", None)):
            station = self._stations[device.device_id]
            if isinstance(command, faults.Absent):
                station.connected = not command.on
                station.fall_silent()
                continue
            if isinstance(command, faults.BusOff):
                station.off, station.errors = command.on, 0
                station.fall_silent()
            device.do(command, t)

    def _switch_adapter(self, off: bool, t: float) -> None:
        """The adapter's controller goes bus-off, or is started again."""
        self._adapter_off = off
        for client, station in self._clients.items():
            station.off, station.errors = off, 0
            station.fall_silent()
            client.queue_error(BUS_OFF if off else RESTARTED, t + self._wall_offset_s)
        self._note("bus_off" if off else "restarted", t, source="adapter")

    def _heal(self, t: float) -> None:
        self._faults.heal()
        self._echo = False
        if self._adapter_off:
            self._switch_adapter(False, t)
        for device in self._devices:
            station = self._stations[device.device_id]
            station.connected, station.off, station.errors = True, False, 0
            device.heal(t)

    def _named(self, ids: tuple[int, ...] | None) -> list[Device]:
        here = {device.device_id for device in self._devices}
        if unknown := set(ids or ()) - here:
            raise SimulationError(f"bus {self.name} has no device {sorted(unknown)}; it has {sorted(here)}")
        return [device for device in self._devices if ids is None or device.device_id in ids]

    def _post(self, station: Station, frame: Frame, t: float) -> None:
        """Send a frame after the active faults were applied."""
        name, ids = self._struck(station, frame)
        if ids is None:
            self._wire.send(station, frame, t)
        elif not self._faults.strikes(faults.Mute, ids, name):
            for data, late_s in self._faults.shape(frame.data, ids, name, but=(faults.Mute, faults.BadCrc)):
                self._wire.send(station, replace(frame, data=data[:MOST_DATA]), t + late_s)

    def _struck(self, station: Station, frame: Frame) -> tuple[str, tuple[int, ...] | None]:
        """A frame's name, and the device whose faults affect it; only faults that name a client's frame affect it."""
        if self._faults.empty:
            return "", None
        name, node = self.label(frame)
        if station.device_id is not None:
            return name, (station.device_id,)
        if not self._faults.names(name):
            return name, None
        return name, () if node is None else (node,)

    # the wire's referee

    def corrupts(self, sender: Station, frame: Frame) -> bool:
        """Whether an injected fault corrupts this frame."""
        name, ids = self._struck(sender, frame)
        return ids is not None and self._faults.strikes(faults.BadCrc, ids, name)

    def passed(self, sender: Station, frame: Frame, t: float) -> None:
        """Log a frame that was sent, and echo it if the adapter echoes."""
        self._frame("", sender, frame, t)
        if self._echo and sender.device_id is None:
            sender.deliver(frame, t)

    def destroyed(self, sender: Station, frame: Frame, t: float) -> None:
        """Log a destroyed frame, and report it to all clients."""
        self._frame("destroyed", sender, frame, t)
        for client in self._clients:
            client.queue_error(BUS_ERROR, t + self._wall_offset_s)
        if sender.off and sender.device_id is None:
            self._switch_adapter(True, t)
        elif sender.off:
            self._note("bus_off", t, source=sender.name, device_id=sender.device_id)

    def lost(self, sender: Station, frame: Frame, t: float) -> None:
        """Logs a frame that was dropped from the queue of its sender."""
        self._frame("lost", sender, frame, t)

    # the adapter's observer

    def joined(self, client: Client) -> None:
        """Attaches the client to the wire as a station of its own."""
        station = Station(client.name, lambda frame, t: self._deliver(client, frame, t))
        station.off = self._adapter_off
        self._clients[client] = station
        self._wire.attach(station)
        self._note("joined", time.monotonic(), source=client.name)

    def left(self, client: Client) -> None:
        """Detaches the client from the wire, with the frames that it had not sent."""
        self._wire.detach(self._clients.pop(client))
        self._note("left", time.monotonic(), source=client.name)

    def submitted(self, client: Client, frame: Frame, t: float) -> None:
        """Queues a frame of the client."""
        self._post(self._clients[client], frame, t)

    def misunderstood(self, client: Client, text: str) -> None:
        """Logs text of the client that is not a valid command."""
        self._note("misunderstood", time.monotonic(), source=client.name, detail=text)

    def _deliver(self, client: Client, frame: Frame, t: float) -> None:
        if not client.queue_frame(frame, t + self._wall_offset_s) and client.overrun == 1:
            self._note("overrun", t, source=client.name, detail="the client does not read; frames for it are lost")

    def _note(self, name: str, t: float, *, source: str = "", device_id: int | None = None, detail: str = "") -> None:
        self.log.add(LogEntry(t, self.name, "event", name, device_id, source=source, detail=detail))

    def _frame(self, name: str, sender: Station, frame: Frame, t: float) -> None:
        """A frame that got through has its own name; one that did not is an event."""
        label, node = self.label(frame)
        entry = LogEntry(
            t,
            self.name,
            "event" if name else "frame",
            name or label,
            node if sender.device_id is None else sender.device_id,
            hex=frame.data.hex(),
            can_id=frame.can_id,
            source=sender.name,
            direction="in" if sender.device_id is None else "out",
            detail=str(frame) if name or frame.remote or frame.extended else "",
        )
        self.log.add(entry)
