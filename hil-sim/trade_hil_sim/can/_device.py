"""Devices on a CAN bus: the interface that the bus requires, and a base class for devices that move a joint."""

from abc import abstractmethod
from collections.abc import Callable
from math import inf, remainder, tau
from typing import Protocol

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.log._byte_log import LogEntry
from trade_hil_sim.mechanics._device import Emit, JointModel
from trade_hil_sim.mechanics._shaft import Shaft
from trade_hil_sim.mechanics._truth import DeviceState

from ._frame import Frame

Send = Callable[[Frame, float], None]
"""Sends a frame from the time given on."""


class Device(Protocol):
    """A device on the bus. The bus's thread makes all calls, with the time in seconds (monotonic)."""

    @property
    def device_id(self) -> int:
        """Its id on the bus."""
        ...

    joint: str
    due: float
    """When `advance` should be called next; infinity if only frames matter."""
    send: Send
    """Set by the bus."""
    emit: Emit
    """Set by the bus."""

    def hear(self, frame: Frame, t: float) -> None:
        """A frame has come; not called while it is off the bus."""
        ...

    def advance(self, t: float) -> None:
        """Run everything that is due by time `t`; `due` is later afterwards."""
        ...

    def do(self, command: faults.Command, t: float) -> None:
        """Carry out a fault or an order; raises `SimulationError` if it does not support it."""
        ...

    def heal(self, t: float) -> None:
        """End every fault of sensors and shafts."""
        ...

    def state(self, t: float) -> DeviceState:
        """Its actual state."""
        ...


class JointDevice(JointModel):
    """A device that moves a joint.

    Args:
        device_id: its id on the bus.
        shaft: what it moves.
        joint: name of the joint, for the log.
        model: what it is called.
        rad_per_unit: angle of the joint per unit of the shaft's position; negative if they turn in opposite directions.
        offset_rad: the joint's angle at position 0.
    """

    turn: float = tau
    """One turn of the motor, in units of the shaft's position."""
    counts_per_unit: float = 1000
    """Resolution in the log and in orders, where the device itself has no counts."""

    def __init__(
        self, device_id: int, shaft: Shaft, *, joint: str, model: str, rad_per_unit: float, offset_rad: float
    ) -> None:
        super().__init__(joint, model, rad_per_unit, offset_rad)
        self._device_id, self._shaft = device_id, shaft
        self.send: Send = lambda frame, t: None  # noqa: ARG005 - the bus sets it
        self.due = inf
        self._frozen: tuple[float, float] | None = None
        """Position and speed that it shows instead of the true ones."""

    @property
    def device_id(self) -> int:
        """Its id on the bus."""
        return self._device_id

    @abstractmethod
    def hear(self, frame: Frame, t: float) -> None:
        """A frame has come."""

    @abstractmethod
    def _plan(self, t: float) -> None:
        """Log new events, and set the time of the next call."""

    @abstractmethod
    def _place(self, position: float, t: float) -> None:
        """Turn the shaft by hand, to a position as the device reports it."""

    @abstractmethod
    def _restart(self, t: float) -> None:
        """Restart, as after a loss of power."""

    @abstractmethod
    def _lose_zero(self, position: float, t: float) -> None:
        """Report another position from now on; the shaft stays where it is."""

    # where it is

    def _position(self, t: float) -> float:
        """Where the shaft is, as the device reports it."""
        return self._shaft.position(t)

    def counts(self, t: float) -> int:
        """Where the shaft really is, in counts."""
        return round(self._position(t) * self.counts_per_unit)

    def _units(self, t: float) -> tuple[float, float]:
        return self._shaft.position(t), self._shaft.speed(t)

    def _moving(self, t: float) -> bool:
        return self._shaft.moving(t)

    def _shown(self, t: float) -> tuple[float, float]:
        """Position and speed as its sensor has them."""
        return (self._position(t), self._shaft.speed(t)) if self._frozen is None else self._frozen

    # faults

    def do(self, command: faults.Command, t: float) -> None:
        """Carry out a fault or an order; raises `SimulationError` if it does not support it."""
        if isinstance(command, faults.Absent):  # the bus disconnects its station
            raise self._refusal(command)
        super().do(command, t)
        if isinstance(command, faults.BrownOut) and command.zero != "kept":
            within = remainder(self._position(t), self.turn) if command.zero == "turn" else 0.0
            self._lose_zero(within, t)
        self._plan(t)

    def _do_rare(self, command: faults.Command, t: float) -> None:
        match command:
            case faults.Place():
                self._place(command.counts / self.counts_per_unit, t)
            case faults.BusOff():
                self._bus_off(command.on, t)
            case _:
                super()._do_rare(command, t)

    def _bus_off(self, on: bool, t: float) -> None:
        """Its controller is off the bus, or on it again."""
        self.note("bus_off" if on else "restarted", t)

    def heal(self, t: float) -> None:
        """End every fault of sensors and shaft; errors stay until they are cleared."""
        super().heal(t)
        self._plan(t)

    def freeze(self, on: bool, t: float, *, tick: bool = False) -> None:  # noqa: ARG002 - it has no clock to show
        """Freeze the measured position, or show the truth again."""
        self._frozen = (self._position(t), 0.0) if on else None

    def brown_out(self, t: float) -> None:
        """Lose power for a moment."""
        self.note("brown_out", t)
        self._restart(t)

    # the log

    def _journal(
        self,
        name: str,
        data: bytes,
        moves: bool,
        t: float,
        *,
        address: int | None = None,
        registers: tuple[str, ...] = (),
        position_counts: int | None = None,
    ) -> None:
        """Log an instruction that is carried out."""
        entry = LogEntry(
            t,
            "",
            "instruction",
            name,
            self.device_id,
            joint=self.joint,
            hex=data.hex(),
            address=address,
            registers=registers,
            moves=moves,
            position_counts=position_counts,
        )
        self.emit(entry)
