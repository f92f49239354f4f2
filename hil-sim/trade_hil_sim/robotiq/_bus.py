"""A simulated Modbus line with 2F-85 grippers, with a log and scripted faults."""

import time
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Final

from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import ByteLog, LogEntry
from trade_hil_sim.serial._device_bus import DeviceLine
from trade_robotfile import Gripper as GripperRecord
from trade_robotfile import Joint, SerialBus

from . import _table as table
from ._gripper import Gripper
from ._protocol import (
    BROADCAST,
    MOST_REGISTERS,
    ExceptionCode,
    Function,
    Request,
    RequestReader,
    exception,
    read_answer,
    write_answer,
)

MODEL: Final = "2F-85"
_BAUDS: Final = (9600, 19_200, 38_400, 57_600, 115_200)
_GAP_CHARACTERS: Final = 3.5
_BITS: Final = 10
_WRITING: Final = frozenset({Function.WRITE_ONE, Function.WRITE, Function.READ_WRITE})
_NAMES: Final = ("action_request", "position_request", "speed_and_force")


class RobotiqBus(DeviceLine[Gripper]):
    """Grippers on one serial line; a client opens `port` as it would a real adapter.

    Args:
        devices: grippers on the bus, each with an id of its own.
        port: stable path the client opens; made here, gone after `close`.
        name: of the bus, in the log.
        log: where to record; default: a log in memory, at `log`.
        paced: take the time of the real wire, the gap before an answer included; else answer as fast as possible.
        clock: the grippers' clock, in seconds. The line itself keeps real time.
    """

    @cached_property
    def _reader(self) -> RequestReader:
        return RequestReader()

    @classmethod
    def from_robot(
        cls,
        bus: SerialBus,
        devices: "Sequence[Joint | GripperRecord]",
        port: Path,
        *,
        log: ByteLog | None = None,
        paced: bool = True,
    ) -> "RobotiqBus":
        """The bus a robot file describes, each gripper open and not activated.

        Args:
            bus: the bus's record.
            devices: the grippers on it.
            port: path the client will open instead of the record's.
            log: where to record.
            paced: take the time of the real wire.

        Raises:
            SimulationError: a model or baud rate that is not simulated.
        """
        if bus.baud not in _BAUDS:
            known = ", ".join(map(str, _BAUDS))
            raise SimulationError(f"bus.{bus.name}.baud: {bus.baud} is no rate of a {MODEL}; there is {known}")
        for device in devices:
            if device.model != MODEL:
                raise SimulationError(f'"{device.name}".model: {device.model!r} is not simulated; there is {MODEL}')
        t = time.monotonic()
        grippers = [Gripper(device.id, name=device.name, t=t, baud=bus.baud) for device in devices]
        return cls(grippers, port, name=bus.name, log=log, paced=paced)

    # --- requests

    def _silent_for(self, s: float) -> None:
        self._reader.silence(s)

    def _take(self, data: bytes, t: float) -> None:
        baud = self._line.client_baud
        hearing = [gripper for gripper in self._devices if baud in {None, gripper.baud} and not gripper.absent]
        for request in self._reader.feed(data) if hearing else ():
            if request is None:
                self.log.add(LogEntry(t, self.name, "instruction", "damaged"))
            else:
                self._carry_out(request, hearing, t)

    def _carry_out(self, request: Request, hearing: list[Gripper], t: float) -> None:
        now = self._clock()
        meant = [one for one in hearing if request.device_id in {BROADCAST, one.device_id}]
        self._note(request, meant, t)
        for gripper in meant:
            gripper.heard(now)
            answer = _obey(gripper, request, now)
            if isinstance(answer, ExceptionCode):
                gripper.note("refused", now, answer.name.lower())
                answer = exception(request, answer) if gripper.exceptions or gripper.foreign else None
            silenced = self._faults.silences(gripper.device_id, request.name)
            if answer is not None and request.device_id != BROADCAST and not silenced:
                gap_s = _GAP_CHARACTERS * _BITS / gripper.baud
                self._answer(answer, (gripper.device_id,), request.name, after_s=gap_s, device_id=gripper.device_id)

    # --- the log

    def _note(self, request: Request, meant: list[Gripper], t: float) -> None:
        writes = request.function in _WRITING
        first = request.write_at - table.COMMAND
        touched = range(first, first + len(request.values)) if writes else range(0)
        names = tuple(_NAMES[at] for at in touched if 0 <= at < len(_NAMES))
        values = b"".join(value.to_bytes(2, "big") for value in request.values)
        address = request.write_at if writes else request.read_at
        moves = any(_moves(one, request) for one in meant) if names else False
        self.log.add(
            LogEntry(
                t,
                self.name,
                "instruction",
                request.name,
                request.device_id,
                joint=meant[0].name if len(meant) == 1 else "",
                hex=values.hex(),
                address=address,
                registers=names,
                moves=moves,
            )
        )


def _moves(gripper: Gripper, request: Request) -> bool:
    """Whether a write commands motion: to go, to activate, or to release automatically."""
    before, now = gripper.command, list(gripper.command)
    for at, value in enumerate(request.values, request.write_at - table.COMMAND):
        if 0 <= at < len(now):
            now[at] = value
    action = now[0] >> 8
    rising = action & table.ACTIVATE and not before[0] >> 8 & table.ACTIVATE
    return bool(rising or action & (table.GO | table.AUTO_RELEASE))


def _obey(gripper: Gripper, request: Request, t: float) -> bytes | ExceptionCode | None:
    """Carry a request out; return the answer, or the exception."""
    if request.function not in set(Function):
        return ExceptionCode.FUNCTION
    if not request.whole or request.read_count > MOST_REGISTERS:
        return ExceptionCode.VALUE
    if gripper.foreign:
        return ExceptionCode.ADDRESS
    reads = request.function not in {Function.WRITE_ONE, Function.WRITE}
    if reads and gripper.read(request.read_at, request.read_count, t) is None:
        return ExceptionCode.ADDRESS
    if request.function in _WRITING and not gripper.write(request.write_at, request.values, t):
        return ExceptionCode.ADDRESS
    values = gripper.read(request.read_at, request.read_count, t) if reads else None
    return write_answer(request) if values is None else read_answer(request, values)
