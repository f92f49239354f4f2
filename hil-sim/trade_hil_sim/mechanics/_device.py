"""Base classes of simulated devices: they take faults and orders, log events, and report their true state.

Time is an argument everywhere, in seconds on the clock of the bus; everything happens in `advance`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.log._byte_log import LogEntry
from trade_hil_sim.mechanics._truth import DeviceState, GripperTruth
from trade_robotfile import Joint

Emit = Callable[[LogEntry], None]
"""Adds a line to the log; a bus fills in its name."""


def unheard(entry: LogEntry) -> None:
    """Discard a line: the device is on no bus."""


def start_rad(joint: Joint) -> float:
    """The initial position of a joint's shaft, from its offset: at zero, or as near as the joint's limits allow."""
    angle_rad = max(joint.min_rad, min(joint.max_rad, 0.0))
    return (-1 if joint.reversed else 1) * (angle_rad - joint.offset_rad)


def version_of(joint: Joint, count: int) -> tuple[int, ...]:
    """The numbers of the firmware version that the robot file names for a joint.

    Raises:
        SimulationError: it is no version of ``count`` numbers of one byte, which a device of this kind has.
    """
    numbers = (joint.firmware or "").split(".")
    if len(numbers) != count or not all(number.isdecimal() and int(number) < 256 for number in numbers):
        form = ".".join("N" * count)
        raise faults.SimulationError(f'joint."{joint.name}".firmware: {joint.firmware!r} has not the form {form}')
    return tuple(map(int, numbers))


class DeviceModel(ABC):
    """A device on a bus, as faults and orders see it."""

    thing = "a device"
    """The kind of device, in messages."""
    healthy: tuple[float, int] = (24.0, 30)
    """Its supply in V and its temperature in C when nothing is wrong."""

    def __init__(self) -> None:
        self.emit: Emit = unheard
        self.absent = False
        """Off the bus: it neither receives nor answers."""
        self.supply_v, self.temperature_c = self.healthy

    @property
    @abstractmethod
    def device_id(self) -> int:
        """Its id on the bus."""

    @abstractmethod
    def advance(self, t: float) -> None:
        """Run everything that is due by time `t`, in order."""

    @abstractmethod
    def state(self, t: float) -> DeviceState | GripperTruth:
        """Its actual state at time `t`."""

    def do(self, command: faults.Command, t: float) -> None:
        """Carry out a fault or an order; raises `SimulationError` if it does not support it."""
        self.advance(t)
        match command:
            case faults.Absent():
                self.absent = command.on
            case faults.Freeze():
                self.freeze(command.on, t, tick=command.tick)
            case faults.Jam():
                self.jam(command.on, t)
            case faults.WrongModel():
                self.wrong_model(command.number)
            case faults.BrownOut():
                self.brown_out(t)
            case faults.Supply():
                self.set_supply(t, voltage_v=command.voltage_v, temperature_c=command.temperature_c)
            case _:
                self._do_rare(command, t)

    def _do_rare(self, command: faults.Command, t: float) -> None:  # noqa: ARG002 - for those that know more
        """Carry out a command that only some kinds of devices support."""
        raise self._refusal(command)

    def _refusal(self, command: faults.Command) -> faults.SimulationError:
        return faults.SimulationError(f"{type(command).__name__} is nothing that happens to {self.thing}")

    def heal(self, t: float) -> None:
        """End every fault of sensors and shaft; errors stay until they are cleared."""
        self.advance(t)
        self.absent = False
        self.freeze(False, t)
        self._restore(t)
        self._unjam(t)

    def _unjam(self, t: float) -> None:
        self.jam(False, t)

    @abstractmethod
    def _restore(self, t: float) -> None:
        """Report its true model again, and end lasting faults of the supply."""

    @abstractmethod
    def freeze(self, on: bool, t: float, *, tick: bool = False) -> None:
        """Freeze the measured position, and the clock if asked, or show the truth again."""

    @abstractmethod
    def jam(self, on: bool, t: float) -> None:
        """Jam the shaft, or release it."""

    @abstractmethod
    def wrong_model(self, number: int) -> None:
        """Report another model."""

    @abstractmethod
    def brown_out(self, t: float) -> None:
        """Lose power for a moment."""

    def set_supply(self, t: float, *, voltage_v: float | None = None, temperature_c: int | None = None) -> None:
        """Change what it measures of its supply and housing."""
        self.supply_v = self.supply_v if voltage_v is None else voltage_v
        self.temperature_c = self.temperature_c if temperature_c is None else temperature_c
        self._check_supply(t)

    def _check_supply(self, t: float) -> None:  # noqa: B027 - not all have limits
        """Fail if what it measures is outside its limits."""


class Controller(NamedTuple):
    """The actual state of the controller of a joint; see `DeviceState`."""

    goal_counts: int
    torque: bool
    operating_mode: int
    hardware_error: int
    watchdog: int


class JointModel(DeviceModel):
    """A device that moves a joint.

    Args:
        joint: name of the joint.
        model: model of the device.
        rad_per_unit: angle of the joint per unit of the shaft's position; negative if they turn in opposite directions.
        offset_rad: the joint's angle at position 0.
    """

    def __init__(self, joint: str, model: str, rad_per_unit: float, offset_rad: float) -> None:
        super().__init__()
        self.joint, self.model_name = joint, model
        self._rad_per_unit, self._offset_rad = rad_per_unit, offset_rad
        self._underway = False

    @abstractmethod
    def counts(self, t: float) -> int:
        """Where the shaft really is, in counts."""

    @abstractmethod
    def _units(self, t: float) -> tuple[float, float]:
        """The shaft's position and speed, from where the joint is at its offset."""

    @abstractmethod
    def _moving(self, t: float) -> bool:
        """Whether the shaft turns, or is about to."""

    @abstractmethod
    def _controller(self) -> Controller:
        """The actual state of its controller."""

    def joint_rad(self, t: float) -> float:
        """The joint's angle where the shaft really is."""
        return self._offset_rad + self._units(t)[0] * self._rad_per_unit

    def state(self, t: float) -> DeviceState:
        """Its actual state at time `t`."""
        self.advance(t)
        return DeviceState(
            device_id=self.device_id,
            joint=self.joint,
            model=self.model_name,
            position_counts=self.counts(t),
            position_rad=self.joint_rad(t),
            velocity_rad_s=self._units(t)[1] * self._rad_per_unit,
            moving=self._moving(t),
            absent=self.absent,
            **self._controller()._asdict(),
        )

    def note(self, name: str, t: float, detail: str = "") -> None:
        """Log an event, with where the joint is."""
        entry = LogEntry(
            t,
            "",
            "event",
            name,
            self.device_id,
            joint=self.joint,
            position_counts=self.counts(t),
            position_rad=self.joint_rad(t),
            detail=detail,
        )
        self.emit(entry)

    def _note_motion(self, t: float) -> None:
        """Log that it has started, or come to rest."""
        moving = self._moving(t)
        if moving != self._underway:
            self._underway = moving
            self.note("motion_started" if moving else "at_rest", t, self._bound_for() if moving else "")

    def _bound_for(self) -> str:
        """The target of the motion, for the log."""
        return ""
