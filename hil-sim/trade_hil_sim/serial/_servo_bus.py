"""A simulated bus of servos: it distributes packets and logs instructions."""

import time
from abc import abstractmethod
from collections.abc import Collection, Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, Generic, TypeVar

from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog, LogEntry
from trade_hil_sim.mechanics._device import start_rad
from trade_hil_sim.serial._device_bus import DeviceLine
from trade_hil_sim.serial._packets import BROADCAST, Packet, PacketReader, Writing
from trade_hil_sim.serial._registers import Memory, Register
from trade_hil_sim.serial._servo import CENTRE, RAD_PER_COUNT, ServoModel, ServoShaft
from trade_robotfile import Joint, SerialBus

if TYPE_CHECKING:
    from typing_extensions import Self

PAUSE_S: Final = 0.1
"""A packet whose next byte has not come after this long is discarded."""
_Servo = TypeVar("_Servo", bound=ServoModel[Memory[Register], ServoShaft])
_Packet = TypeVar("_Packet", bound=Packet)


class ServoBus(DeviceLine[_Servo], Generic[_Servo, _Packet]):
    """Servos on one serial line; a client opens `port` as it would a real adapter. Two of one id answer at once."""

    models: ClassVar[Collection[str]]
    """Names of the models that are simulated."""
    bauds: ClassVar[Collection[int]]
    motion: ClassVar[frozenset[str]]
    """Registers whose write could start a motion, or switch off torque."""
    _deaf_to: int | None = None
    """The baud rate of the client that was logged as wrong last."""

    @classmethod
    def from_robot(
        cls, bus: SerialBus, joints: Sequence[Joint], port: Path, *, log: ByteLog | None = None, paced: bool = True
    ) -> "Self":
        """The bus a robot file describes, each joint at its zero (or as near as its limits allow).

        Args:
            bus: the bus's record.
            joints: the joints on it.
            port: path the client will open instead of the record's.
            log: where to record.
            paced: take the time of the real wire.

        Raises:
            SimulationError: a model or baud rate that is not simulated.
        """
        return cls([cls._servo_for(bus, joint) for joint in joints], port, name=bus.name, log=log, paced=paced)

    @classmethod
    def _servo_for(cls, bus: SerialBus, joint: Joint) -> _Servo:
        if joint.model not in cls.models:
            known = ", ".join(sorted(cls.models))
            raise SimulationError(f'joint."{joint.name}".model: {joint.model!r} is not simulated; there is {known}')
        if bus.baud not in cls.bauds:
            known = ", ".join(map(str, sorted(cls.bauds)))
            raise SimulationError(f"bus.{bus.name}.baud: {bus.baud} is no rate of {joint.model}; there is {known}")
        t = time.monotonic()
        servo = cls._new_servo(joint, bus.baud, CENTRE + round(start_rad(joint) / RAD_PER_COUNT), t)
        servo.resemble(joint, t)
        return servo

    @classmethod
    @abstractmethod
    def _new_servo(cls, joint: Joint, baud: int, position_counts: int, t: float) -> _Servo:
        """The servo of a joint."""

    @abstractmethod
    def _new_reader(self) -> PacketReader[_Packet]:
        """A parser for the client's bytes."""

    @abstractmethod
    def _carry_out(self, servos: list[_Servo], packet: _Packet, t: float) -> None:
        """Let the servos that receive a packet carry it out."""

    @cached_property
    def _reader(self) -> PacketReader[_Packet]:
        return self._new_reader()

    def _silent_for(self, s: float) -> None:
        if s > PAUSE_S:
            self._reader.reset()

    def _take(self, data: bytes, t: float) -> None:
        hearing = self._hearing(t)
        for packet in self._reader.feed(data) if hearing else ():
            self._note(packet, t)
            self._carry_out([servo for servo in hearing if servo.hears], packet, self._clock())

    def _hearing(self, t: float) -> list[_Servo]:
        """Servos set to the baud rate the client speaks at; to others it is noise."""
        baud = self._line.client_baud
        hearing = [servo for servo in self._devices if baud is None or servo.baud == baud]
        if hearing:
            self._deaf_to = None
        elif baud != self._deaf_to:
            self._deaf_to = baud
            rates = sorted({servo.baud for servo in self._devices})
            detail = f"the client speaks at {baud}, the devices listen at {rates}"
            self.log.add(LogEntry(t, self.name, "event", "wrong_baud", detail=detail))
            self._reader.reset()
        return hearing

    # the log

    def _note(self, packet: _Packet, t: float) -> None:
        """One instruction went over the bus; a group write makes one entry for each device."""
        writings = packet.writings()
        for writing in writings:
            self._note_writing(packet.name, writing, t)
        if not writings:
            self._note_other(packet, t)

    def _note_other(self, packet: _Packet, t: float) -> None:
        asked = packet.readings()
        ids = tuple(wish.device_id for wish in asked) if packet.device_id == BROADCAST else ()
        address = asked[0].address if asked else None
        data = packet.params.hex()
        self.log.add(
            LogEntry(t, self.name, "instruction", packet.name, packet.device_id, ids, hex=data, address=address)
        )

    def _note_writing(self, name: str, writing: Writing, t: float) -> None:
        addressed = self._addressed(writing.device_id)
        registers = self._touched([(servo, writing) for servo in addressed or self._devices])
        moves = bool(self.motion & set(registers))
        mover = addressed[0] if moves and len(addressed) == 1 else None
        entry = LogEntry(
            t,
            self.name,
            "instruction",
            name,
            writing.device_id,
            joint="" if mover is None else mover.joint,
            hex=writing.data.hex(),
            address=writing.address,
            registers=registers,
            moves=moves,
            position_counts=None if mover is None else mover.counts(t),
        )
        self.log.add(entry)

    def _touched(self, writings: Iterable[tuple[_Servo, Writing]]) -> tuple[str, ...]:
        """Names of the registers that are written, through indirect addresses."""
        found = (name for servo, (_, address, data) in writings for name in servo.memory.touched(address, len(data)))
        return tuple(dict.fromkeys(found))

    def _addressed(self, device_id: int) -> list[_Servo]:
        return [s for s in self._devices if device_id in {BROADCAST, s.device_id, s.shadow_id}]
