"""A simulated controller with its arm: the three ports of clients, one thread, faults, and the log."""

import random
import socket
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.faults._answer_faults import ActiveFaults
from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog, LogEntry
from trade_hil_sim.mechanics._truth import ArmTruth, BusState
from trade_hil_sim.robot._bus_thread import BusThread, ready
from trade_robotfile import Arm as ArmRecord
from trade_robotfile import Bus

from ._arm import HOME, Arm
from ._dashboard import GREETING, Dashboard, lines_in
from ._program import Program
from ._protocol import Packet
from ._rtde import Rtde, RtdeSession, measured
from ._table import SafetyMode
from ._tcp import MOST_HELD, Client, listeners

ANSWER_S: Final = 10.0
_ARM: Final = 0
"""The id of the arm in faults: it is the only one of its controller."""
_REBOOT_S: Final = 0.5
_TRIES: Final = 100
_CATCH_UP: Final = 25
"""Cycles that are caught up when this thread was late; more are skipped, as if the controller had paused."""
_MOVING: Final = ("actual_q", "actual_qd", "target_q", "target_qd", "actual_TCP_pose", "target_TCP_pose")


class UrBus(BusThread):
    """One controller on its own loopback address; its ports are those of a real one.

    Args:
        arm: what it moves.
        host: a loopback address; default: one whose ports are free.
        name: of the bus, in the log.
        rate_hz: cycles a second; default: 500, or 125 for the arms of a CB3.
        remote: whether it is in remote control.
        lacks: ports that it does not open: ``dashboard`` as with PolyScope X, ``rtde`` or ``script`` as switched off.
        log: where to record; default: a log in memory, at `log`.
    """

    def __init__(
        self,
        arm: Arm | None = None,
        *,
        host: str = "",
        name: str = "bus",
        rate_hz: float | None = None,
        remote: bool = True,
        lacks: Collection[str] = (),
        log: ByteLog | None = None,
    ) -> None:
        super().__init__(name, ANSWER_S)
        self.port = host
        self.arm = Arm() if arm is None else arm
        self.log = ByteLog() if log is None else log
        self.arm.emit = self._emit
        self.arm.t = time.monotonic()
        rate_hz = rate_hz or self.arm.series.rate_hz
        self._program = Program(self.arm, self._emit, 1 / rate_hz)
        self._rtde = Rtde(self._program, rate_hz)
        self._dashboard = Dashboard(self._program, remote=remote)
        self._period_s = 1 / rate_hz
        self._lacks = lacks
        self._faults = ActiveFaults()
        self._absent = False
        self._listeners: dict[str, socket.socket] = {}
        self._clients: dict[Client, str] = {}
        self._sessions: dict[Client, RtdeSession] = {}
        self._count = 0
        self._boots_at: float | None = None

    @classmethod
    def from_robot(
        cls,
        bus: Bus,
        devices: Sequence[ArmRecord],
        port: Path,  # noqa: ARG003 - a controller is no path; its address is known when it is open
        *,
        log: ByteLog | None = None,
        paced: bool = True,  # noqa: ARG003 - a controller has a clock of its own
    ) -> "UrBus":
        """The controller a robot file describes. Where that names no loopback address, one is chosen.

        Raises:
            SimulationError: there is not exactly one arm, or of a model that is not simulated.
        """
        if len(devices) != 1:
            raise SimulationError(f"bus.{bus.name}: a controller has one arm, but there are {len(devices)}")
        record = devices[0]
        host = str(getattr(bus, "host", ""))
        arm = Arm(record.model, name=record.name, q=tuple(record.poses.get("home", HOME)))
        return cls(arm, host=host if host.startswith("127.") else "", name=bus.name, log=log)

    # --- for any thread

    def state(self) -> BusState:
        """The truth, now."""
        return self._in_thread(self._state)

    def do(self, command: faults.Command) -> None:
        """Carry out one fault or order; raises `SimulationError` if it does not support it."""
        self._in_thread(lambda: self._do(command))

    # --- the thread

    def _begin(self) -> None:
        self._listen()
        self.arm.t = time.monotonic()

    def _step(self) -> None:
        self._serve()
        self._pass_time(time.monotonic())
        for client in tuple(self._clients):
            if not client.flush():
                self._drop(client)

    def _serve(self) -> None:
        watched: list[int | Client | socket.socket] = [self._errands.wake_read, *self._listeners.values()]
        watched += [] if self._absent else list(self._clients)
        readable = ready(watched, [client for client in self._clients if client.unsent], self._patience_s())
        names = {listener: name for name, listener in self._listeners.items()}
        for thing in readable:
            if isinstance(thing, socket.socket):
                self._accept(names[thing], thing)
            elif isinstance(thing, Client):
                self._hear(thing)
        if self._errands.wake_read in readable:
            self._errands.run()

    def _patience_s(self) -> float:
        times = [self.arm.t + self._period_s, *(due for client in self._clients if (due := client.due) is not None)]
        return max(0.0, min(times) - time.monotonic())

    def _pass_time(self, now: float) -> None:
        """Run every cycle that is due: the joints, the script, and the data for clients."""
        behind = int((now - self.arm.t) / self._period_s)
        if behind > _CATCH_UP:
            self.arm.t += (behind - _CATCH_UP) * self._period_s
        while self.arm.t + self._period_s <= now:
            self.arm.advance(self._period_s)
            self._program.cycle()
            if not self._absent:
                self._rtde.cycle()
        if self._boots_at is not None and now >= self._boots_at:
            self._boots_at = None
            self._note("booted")
            self._listen()

    # --- connections

    def _listen(self) -> None:
        """Open the three ports; without a given address, on the first address where all are free."""
        for _ in range(_TRIES):
            host = self.port or f"127.{random.randint(64, 254)}.{random.randint(0, 254)}.{random.randint(1, 254)}"  # noqa: S311 - no secret
            try:
                self._listeners = listeners(host, self._lacks)
            except OSError as problem:
                if self.port:
                    raise SimulationError(f"cannot listen on {host}: {problem}; is another simulator there?") from None
                continue
            self.port = host
            return
        raise SimulationError("found no loopback address with free ports")

    def _accept(self, kind: str, listener: socket.socket) -> None:
        with suppress(OSError):
            connection, _ = listener.accept()
            self._count += 1
            client = Client(connection, f"{kind}{self._count}")
            self._clients[client] = kind
            self._note("joined", source=client.name)
            if kind == "dashboard":
                self._say(client, GREETING.encode() + b"\n", "dashboard")
            elif kind == "rtde":
                self._sessions[client] = self._rtde.joined(lambda packet, name: self._say_packet(client, packet, name))

    def _hear(self, client: Client) -> None:
        if client not in self._clients:
            return
        alive = client.read()
        try:
            self._understand(client)
        except ValueError as problem:
            self._note("misunderstood", source=client.name, detail=str(problem))
            alive = False
        if not alive:
            self._drop(client)

    def _understand(self, client: Client) -> None:
        match self._clients[client]:
            case "rtde":
                self._rtde.received(self._sessions[client], client.held)
            case "dashboard":
                for line in lines_in(client.held):
                    answer = self._dashboard.answer(line)
                    detail = f"{line} -> {answer}"
                    t = time.monotonic()
                    self._emit(LogEntry(t, "", "instruction", "dashboard", source=client.name, detail=detail))
                    self._say(client, answer.encode() + b"\n", "dashboard")
            case _:
                if (whole := client.held.rfind(b"\nend\n")) >= 0:
                    text = client.held[: whole + 5].decode(errors="replace")
                    del client.held[: whole + 5]
                    if self._dashboard.remote and not self._faults.names("script"):
                        self._program.upload(text)
        if len(client.held) > MOST_HELD:
            raise ValueError(f"{len(client.held)} bytes without an end")

    def _say_packet(self, client: Client, packet: Packet, name: str) -> None:
        self._say(client, packet.encode(), name)

    def _say(self, client: Client, data: bytes, name: str) -> None:
        if not self._absent and not self._faults.strikes(faults.Mute, (_ARM,), name):
            client.tell(self._faults.shape(data, (_ARM,), name))

    def _drop(self, client: Client) -> None:
        if self._clients.pop(client, None) is None:
            return
        if (session := self._sessions.pop(client, None)) is not None:
            self._rtde.left(session)
        client.close()
        self._note("left", source=client.name)

    def _end(self) -> None:
        for listener in self._listeners.values():
            listener.close()
        self._listeners = {}
        self._hang_up()

    def _hang_up(self, only: str = "") -> None:
        for client, kind in tuple(self._clients.items()):
            if only in {"", kind}:
                self._drop(client)

    # --- faults and orders

    def _state(self) -> BusState:
        arm, program = self.arm, self._program
        truth = ArmTruth(
            bus=self.name,
            device_id=_ARM,
            arm=arm.name,
            model=arm.model,
            positions_rad=list(arm.q),
            velocities_rad_s=list(arm.speeds),
            pose=list(arm.pose()),
            moving=arm.moving,
            robot_mode=arm.robot_mode.name,
            safety_mode=arm.safety_mode.name,
            program=program.kind,
            freedrive=arm.freedrive,
            speed_fraction=arm.speed_fraction,
            watchdog_hz=program.watchdog_hz,
            absent=self._absent,
        )
        return BusState(name=self.name, port=self.port, plugged=bool(self._listeners), arms=[truth])

    def _do(self, command: faults.Command) -> None:
        if unknown := set(getattr(command, "ids", None) or ()) - {_ARM}:
            raise SimulationError(f"bus {self.name} has no device {sorted(unknown)}; its arm is {_ARM}")
        match command:
            case faults.Unplug() | faults.Replug() | faults.HangUp() | faults.Local():
                self._do_to_ports(command)
            case faults.Heal():
                self._faults.heal()
                self._rtde.frozen, self._absent, self.arm.jammed = {}, False, False
            case faults.AnswerFault():
                self._faults.add(command)
            case faults.Unmute():
                self._faults.unmute(command.ids)
            case faults.Absent(nth=int()):
                raise SimulationError(f"controller {self.name} has its one arm; leave nth out")
            case faults.Absent():
                self._absent = command.on
            case _:
                self._do_to_arm(command)

    def _do_to_ports(self, command: faults.Unplug | faults.Replug | faults.HangUp | faults.Local) -> None:
        match command:
            case faults.Unplug():
                self._end()
                self._note("unplugged")
            case faults.Replug():
                if not self._listeners:
                    self._listen()
                self._note("plugged")
            case faults.HangUp():
                self._hang_up(command.kind)
            case faults.Local():
                self._dashboard.remote = not command.on

    def _do_to_arm(self, command: faults.Command) -> None:
        arm = self.arm
        match command:
            case faults.Freeze():
                names = (*_MOVING, *(("timestamp",) if command.tick else ())) if command.on else ()
                now = measured(arm, self._program)
                self._rtde.frozen = {name: now[name] for name in names}
            case faults.Jam():
                arm.jammed = command.on
            case faults.HardwareFault():
                if command.bits not in set(SafetyMode):
                    known = ", ".join(f"{int(mode)} {mode.name.lower()}" for mode in SafetyMode)
                    raise SimulationError(f"bits of an arm's fault are a safety mode: {known}")
                arm.safety(SafetyMode(command.bits), "by order")
            case faults.BrownOut():
                self._program.stop()
                arm.reboot()
                self._end()
                self._note("rebooted")
                self._boots_at = time.monotonic() + _REBOOT_S
            case _:
                raise SimulationError(f"an arm has nothing like {type(command).__name__}")

    def _note(self, name: str, *, source: str = "", detail: str = "") -> None:
        self._emit(LogEntry(time.monotonic(), "", "event", name, source=source, detail=detail))

    def _emit(self, entry: LogEntry) -> None:
        """Log it as of now: the arm's own time may lag when this thread is late."""
        self.log.add(msgspec.structs.replace(entry, t=time.monotonic(), bus=self.name, device_id=_ARM))
