"""What an instruction packet asks of which device: parameters taken apart. Pure."""

from dataclasses import dataclass

from ._protocol import Instruction, Packet

__all__ = ["Reading", "Writing", "readings", "writings"]

JOINED = frozenset({Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ})


@dataclass(frozen=True, slots=True)
class Reading:
    """Read `length` bytes from `address` of one device."""

    device_id: int
    address: int
    length: int


@dataclass(frozen=True, slots=True)
class Writing:
    """Write `data` to `address` of one device."""

    device_id: int
    address: int
    data: bytes


def readings(packet: Packet) -> list[Reading] | None:
    """What a read, sync read or bulk read (fast or not) asks for; None if its parameters make no sense."""
    params = packet.params
    match packet.instruction:
        case Instruction.READ:
            return [Reading(packet.device_id, _word(params, 0), _word(params, 2))] if len(params) == 4 else None
        case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ:
            if len(params) < 5:
                return None
            return [Reading(device_id, _word(params, 0), _word(params, 2)) for device_id in params[4:]]
        case Instruction.BULK_READ | Instruction.FAST_BULK_READ:
            if not params or len(params) % 5:
                return None
            return [Reading(params[i], _word(params, i + 1), _word(params, i + 3)) for i in range(0, len(params), 5)]
        case _:
            return None


def writings(packet: Packet) -> list[Writing] | None:
    """What a write, reg write, sync write or bulk write asks for; None if its parameters make no sense."""
    params = packet.params
    match packet.instruction:
        case Instruction.WRITE | Instruction.REG_WRITE:
            return [Writing(packet.device_id, _word(params, 0), params[2:])] if len(params) > 2 else None
        case Instruction.SYNC_WRITE:
            return _sync_writings(params)
        case Instruction.BULK_WRITE:
            return _bulk_writings(params)
        case _:
            return None


def _sync_writings(params: bytes) -> list[Writing] | None:
    if len(params) < 6:
        return None
    address, size, rest = _word(params, 0), _word(params, 2), params[4:]
    if size == 0 or len(rest) % (size + 1):
        return None
    return [Writing(rest[i], address, rest[i + 1 : i + 1 + size]) for i in range(0, len(rest), size + 1)]


def _bulk_writings(params: bytes) -> list[Writing] | None:
    found: list[Writing] = []
    while params:
        size = _word(params, 3) if len(params) >= 5 else 0
        if size == 0 or len(params) < 5 + size:
            return None
        found.append(Writing(params[0], _word(params, 1), params[5 : 5 + size]))
        params = params[5 + size :]
    return found or None


def _word(params: bytes, at: int) -> int:
    return int.from_bytes(params[at : at + 2], "little")
