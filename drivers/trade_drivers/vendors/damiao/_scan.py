"""Scanning an open CAN bus for Damiao motors. Reads registers; enables and writes nothing."""

import time
from collections.abc import Callable
from math import isclose
from typing import Final, TypeVar

from trade_drivers.bus.can import Frame
from trade_drivers.commissioning._can_scan import CanBench
from trade_drivers.commissioning._commissioner import Found
from trade_drivers.vendors.damiao import _frames as frames
from trade_drivers.vendors.damiao._frames import MASTER, MODELS, Feedback, Ranges, Register, Status

_ANSWER_S: Final = 0.05
_WHOLE_SECOND_ANSWER_S: Final = 0.005
_ATTEMPTS: Final = 3
_SHARED: Final = (
    "two motors answer to this number. Unplug all but one, give it a number of its own with the vendor's tool, then "
    "plug in the next"
)

_Value = TypeVar("_Value")


class _Silent(Exception):
    """No answer came."""


class DamiaoBench(CanBench):
    """One CAN bus."""

    driver = "damiao"
    remedy = "the vendor's tool"
    zero = "its zero is set by the vendor's tool"

    orders = staticmethod(frames.orders)

    def anybody(self) -> bool:
        return True

    def look(self, device_id: int) -> Found | None:
        try:
            answers = self._register(device_id, Register.POSITION_MAX)
        except _Silent:
            return None
        if len(answers) > 1:
            return self.found(device_id, problem=_SHARED)
        [(can_id, position)] = answers
        if can_id != device_id + MASTER:
            wanted = device_id + MASTER
            problem = f"it answers as {can_id:X}h; set its MST_ID (register 7) to {wanted:X}h by {self.remedy}"
            return self.found(device_id, problem=problem)
        try:
            rest = [self._register(device_id, one)[0][1] for one in (Register.VELOCITY_MAX, Register.TORQUE_MAX)]
            software = self._register(device_id, Register.SOFTWARE)[0][1]
            status = self._status(device_id)
        except _Silent:
            return self.found(device_id, problem="it answers only sometimes; check its cable and the terminations")
        reported = Ranges(position, *rest)
        names = [name for name, ranges in MODELS.items() if all(map(_alike, ranges, reported))]
        return self.found(
            device_id,
            " or ".join(names),
            firmware=f"{software:g}",
            torque=status == Status.ENABLED,
            problem="" if names else f"no known model has its limits (registers 21 to 23): {reported}",
        )

    def _register(self, motor: int, number: Register) -> list[tuple[int, float]]:
        """Returns the identifiers and values of all answers. Raises ``_Silent``."""

        def decode(frame: Frame) -> tuple[int, float] | None:
            value = frames.answer(frame.data, motor, number) if frame.id != frames.BROADCAST else None
            return None if value is None else (frame.id, value)

        return self._asked(frames.read(motor, number), decode)

    def _status(self, motor: int) -> int:
        def decode(frame: Frame) -> int | None:
            if frame.id != motor + MASTER or len(frame.data) != len(frames.ENABLE):
                return None
            return Feedback.decode(frame.data, Ranges(0, 0, 0)).status

        return self._asked(frames.refresh(motor), decode)[0]

    def _asked(self, question: bytes, decode: Callable[[Frame], _Value | None]) -> list[_Value]:
        """Returns the answers, including a second one if there are two motors. Raises ``_Silent``."""
        answers: list[_Value] = []
        for _ in range(_ATTEMPTS):
            self._port.send(frames.BROADCAST, question)
            until = time.monotonic() + _ANSWER_S
            while (left_s := until - time.monotonic()) > 0:
                frame = self._port.receive(left_s)
                if frame is not None and (answer := decode(frame)) is not None:
                    answers.append(answer)
                    until = min(until, time.monotonic() + _WHOLE_SECOND_ANSWER_S)
            if answers:
                return answers
        raise _Silent


def _alike(meant: float, reported: float) -> bool:
    return isclose(meant, reported, rel_tol=1e-3)
