"""A servo under an injected clock, and its reports."""

from collections.abc import Callable
from typing import Any

import pytest

from trade_hil_sim import XM430_W350
from trade_hil_sim.dynamixel import ErrorCode, Servo
from trade_hil_sim.dynamixel._memory import Refusal

TORQUE, WATCHDOG, GOAL, GOAL_VELOCITY, GOAL_PWM = 64, 98, 116, 104, 100
ACCELERATION, VELOCITY = 108, 112
SIZES = {register.address: register.size for register in XM430_W350.registers}


class Rig:
    """A servo, its clock, and its reports."""

    def __init__(self, clock: Any, **options: Any) -> None:
        self.clock = clock
        self.reported: list[tuple[str, float]] = []
        self.servo = Servo(1, t=clock(), emit=lambda entry: self.reported.append((entry.name, entry.t)), **options)

    def write(self, address: int, value: int, size: int | None = None) -> None:
        size = size or SIZES[address]
        self.servo.heard(self.clock())
        self.servo.write(address, value.to_bytes(size, "little", signed=value < 0), self.clock())

    def read(self, address: int, *, signed: bool = False) -> int:
        data = self.servo.read(address, SIZES[address], self.clock())
        return int.from_bytes(data, "little", signed=signed)

    def pass_s(self, s: float) -> None:
        """Time passes in silence."""
        self.servo.advance(self.clock.advance(s))

    def names(self) -> list[str]:
        return [name for name, _ in self.reported]

    def at(self, name: str) -> float:
        return next(t for reported, t in self.reported if reported == name)


@pytest.fixture
def rig(clock: Any) -> Rig:
    return Rig(clock)


@pytest.fixture
def refused() -> Callable[..., None]:
    def check(code: ErrorCode, act: Callable[..., object], *args: Any) -> None:
        with pytest.raises(Refusal) as caught:
            act(*args)
        assert caught.value.code is code, caught.value

    return check
