"""Dispatches instructions to the servos on a bus, and orders their answers. No port, no waiting."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from trade_hil_sim.serial._device_bus import interleaved
from trade_hil_sim.serial._packets import BROADCAST, Reading, Writing

from ._memory import Refusal
from ._protocol import ErrorCode, Instruction, JoinedStatus, Packet, status
from ._servo import Servo

JOINED: Final = frozenset({Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ})
READING: Final = frozenset({Instruction.PING, Instruction.READ, Instruction.SYNC_READ, Instruction.BULK_READ}) | JOINED
GROUP_READS: Final = frozenset({Instruction.SYNC_READ, Instruction.BULK_READ})
GROUP_WRITES: Final = frozenset({Instruction.SYNC_WRITE, Instruction.BULK_WRITE})

_Wish = TypeVar("_Wish", Reading, Writing)


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer on its way out."""

    ids: tuple[int, ...]
    data: bytes
    delay_s: float
    """The device's return delay."""


class Dispatch:
    """Hands an instruction to the servos on a bus.

    Args:
        silent: whether a device's answer is suppressed by a fault: device id, instruction name.
    """

    def __init__(self, silent: Callable[[int, str], bool]) -> None:
        self._silent = silent

    def answers(self, servos: Sequence[Servo], packet: Packet, t: float) -> list[Answer]:
        """Carry out one packet on the servos that receive it; return the answers in order."""
        if not packet.intact:
            return self._to_one(servos, packet, t, _complain_of_crc)
        if packet.instruction in JOINED:
            return self._joined(servos, packet, t)
        if packet.instruction in GROUP_READS:
            return self._group_read(servos, packet, t)
        if packet.instruction in GROUP_WRITES:
            self._group_write(servos, packet, t)
            return []
        if packet.device_id == BROADCAST:
            return self._to_all(servos, packet, t)
        return self._to_one(servos, packet, t, lambda servo: _carry_out(servo, packet, t))

    # to one device, or to all

    def _to_one(self, servos: Sequence[Servo], packet: Packet, t: float, act: Callable[[Servo], bytes]) -> list[Answer]:
        for servo in _shadows(servos, packet.device_id):
            self._obey_shadow(servo, packet, t)
        answers = [self._answer(servo, packet, t, act) for servo in servos if servo.device_id == packet.device_id]
        return _collided(answers)

    def _to_all(self, servos: Sequence[Servo], packet: Packet, t: float) -> list[Answer]:
        found: list[Answer] = []
        for device_id in sorted({servo.device_id for servo in servos}):
            twins = [servo for servo in servos if servo.device_id == device_id]
            answers = [self._answer(servo, packet, t, lambda one: _carry_out(one, packet, t)) for servo in twins]
            found += _collided(answers)
        return found

    def _answer(self, servo: Servo, packet: Packet, t: float, act: Callable[[Servo], bytes]) -> Answer | None:
        device_id, code, params = servo.device_id, ErrorCode.NONE, b""
        delay_s, level = servo.return_delay_s, servo.status_return_level
        try:
            params = act(servo)
        except Refusal as refusal:
            code = refusal.code
            servo.note("refused", t, f"error {code.value}: {refusal}")
        needed = _level_needed(packet)
        if level < needed or self._silent(device_id, packet.name):
            return None
        return Answer((device_id,), status(device_id, servo.error_field(code), params), delay_s)

    def _obey_shadow(self, servo: Servo, packet: Packet, t: float) -> None:
        if packet.intact and packet.instruction == Instruction.WRITE:
            self._write(servo, packet.writings(), t, by_shadow_id=True)

    # to some

    def _group_read(self, servos: Sequence[Servo], packet: Packet, t: float) -> list[Answer]:
        found: list[Answer] = []
        for wish in packet.readings():
            alone = Packet(wish.device_id, packet.instruction, b"")
            twins = [servo for servo in servos if servo.device_id == wish.device_id]
            answers = [self._answer(servo, alone, t, _reader(wish, t)) for servo in twins]
            found += _collided(answers)
        return found

    def _joined(self, servos: Sequence[Servo], packet: Packet, t: float) -> list[Answer]:
        """One answer built by all; after a silent device, the later ones do not answer."""
        wishes = packet.readings()
        joined = JoinedStatus(sum(wish.length for wish in wishes), len(wishes))
        ids: list[int] = []
        delay_s = 0.0
        for wish in wishes:
            servo = next((servo for servo in servos if servo.device_id == wish.device_id), None)
            if servo is None or servo.status_return_level < 1 or self._silent(wish.device_id, packet.name):
                break
            delay_s = delay_s or servo.return_delay_s
            ids.append(wish.device_id)
            self._add_block(joined, servo, wish, t)
        return [Answer(tuple(ids), bytes(joined), delay_s)] if ids else []

    def _add_block(self, joined: JoinedStatus, servo: Servo, wish: Reading, t: float) -> None:
        try:
            data = servo.read(wish.address, wish.length, t)
        except Refusal as refusal:
            servo.note("refused", t, f"error {refusal.code.value}: {refusal}")
            joined.add(wish.device_id, servo.error_field(refusal.code), bytes(wish.length))
        else:
            joined.add(wish.device_id, servo.error_field(), data)

    def _group_write(self, servos: Sequence[Servo], packet: Packet, t: float) -> None:
        for wish in packet.writings():
            for servo in servos:
                if servo.device_id == wish.device_id:
                    self._write(servo, [wish], t)
            for servo in _shadows(servos, wish.device_id):
                self._write(servo, [wish], t, by_shadow_id=True)

    def _write(self, servo: Servo, wishes: Iterable[Writing], t: float, *, by_shadow_id: bool = False) -> None:
        for wish in wishes:
            try:
                servo.write(wish.address, wish.data, t, by_shadow_id=by_shadow_id)
            except Refusal as refusal:
                servo.note("refused", t, f"error {refusal.code.value}: {refusal}")


def _level_needed(packet: Packet) -> int:
    """The status return level from which an instruction is answered; 3 if never."""
    if packet.instruction == Instruction.PING:
        return 0
    if packet.device_id == BROADCAST:
        return 3
    return 1 if packet.instruction in READING else 2


def _shadows(servos: Iterable[Servo], device_id: int) -> list[Servo]:
    return [servo for servo in servos if servo.shadow_id == device_id]


def _collided(given: list[Answer | None]) -> list[Answer]:
    """Devices with one id answer at the same time: the bytes of all arrive interleaved."""
    answers = [answer for answer in given if answer is not None]
    if len(answers) < 2:
        return answers
    mixed = interleaved([answer.data for answer in answers])
    return [Answer(answers[0].ids, mixed, min(a.delay_s for a in answers))]


def _reader(wish: Reading, t: float) -> Callable[[Servo], bytes]:
    return lambda servo: servo.read(wish.address, wish.length, t)


def _complain_of_crc(_: Servo) -> bytes:
    raise Refusal(ErrorCode.CRC, "CRC of the instruction does not match")


def _carry_out(servo: Servo, packet: Packet, t: float) -> bytes:
    """Carry out a packet for one servo; return the parameters of its answer."""
    match packet.instruction:
        case Instruction.PING:
            identity = servo.read(0, 7, t)
            return identity[:2] + identity[6:]
        case Instruction.READ:
            wish = _sensible(packet.readings())[0]
            return servo.read(wish.address, wish.length, t) if packet.device_id != BROADCAST else b""
        case Instruction.WRITE:
            wish = _sensible(packet.writings())[0]
            servo.write(wish.address, wish.data, t)
        case Instruction.REG_WRITE:
            wish = _sensible(packet.writings())[0]
            servo.reg_write(wish.address, wish.data)
        case _:
            _carry_out_rare(servo, packet, t)
    return b""


def _carry_out_rare(servo: Servo, packet: Packet, t: float) -> None:
    match packet.instruction:
        case Instruction.ACTION:
            servo.action(t)
        case Instruction.REBOOT:
            servo.reboot(t)
        case Instruction.CLEAR:
            servo.clear(packet.params, t)
        case Instruction.FACTORY_RESET:
            option = packet.params[0] if len(packet.params) == 1 else -1
            if packet.device_id == BROADCAST and option == 0xFF:
                raise Refusal(ErrorCode.RESULT_FAIL, "factory reset of everything is not open to id 254")
            servo.factory_reset(option, t)
        case _:
            raise Refusal(ErrorCode.INSTRUCTION, f"instruction {packet.name} is not one of mine")


def _sensible(wishes: list[_Wish]) -> list[_Wish]:
    if not wishes:
        raise Refusal(ErrorCode.DATA_LENGTH, "parameters too short or too long")
    return wishes
