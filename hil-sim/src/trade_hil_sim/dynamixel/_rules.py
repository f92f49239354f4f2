"""Rules that tie registers to each other: what may be written when, and which goals ask for no motion.

Source: ROBOTIS e-Manual, descriptions of the models' control tables.
"""

from typing import Final

from ._drive import Mode
from ._memory import ControlTable, Refusal
from ._protocol import ErrorCode
from ._table import EXTENDED_RANGE, Register

__all__ = ["GOALS", "MOTION", "WATCHDOG_EXPIRED", "HardwareError", "check", "seed_goals"]

GOALS: Final = frozenset({"goal_pwm", "goal_current", "goal_velocity", "goal_position"})
MOTION: Final = GOALS | {"torque_enable"}
"""A write to any of these could set something moving, or let go of it."""
WATCHDOG_EXPIRED: Final = 255
"""What register 98 shows after its time has run out."""


class HardwareError:
    """Bits of Hardware Error Status, register 70, and of Shutdown, register 63."""

    VOLTAGE: Final = 0x01
    OVERHEATING: Final = 0x04
    ENCODER: Final = 0x08
    SHOCK: Final = 0x10
    OVERLOAD: Final = 0x20


def check(table: ControlTable, register: Register, value: int, *, by_shadow_id: bool = False) -> None:
    """Raise `Refusal` if the state of the other registers forbids this write."""
    name = register.name
    if register.eeprom:
        _check_unlocked(table, register, by_shadow_id)
    if table.get("bus_watchdog") == WATCHDOG_EXPIRED and (name in GOALS or (name == "bus_watchdog" and value != 0)):
        raise Refusal(ErrorCode.DATA_RANGE, f"{name}: the bus watchdog has expired; write 0 to register 98 first")
    if name == "operating_mode" and value not in table.model.modes:
        raise Refusal(ErrorCode.DATA_RANGE, f"operating mode {value} is none of {sorted(table.model.modes)}")
    if name in GOALS:
        _check_goal(table, name, value)


def _check_unlocked(table: ControlTable, register: Register, by_shadow_id: bool) -> None:
    if table.get("torque_enable"):
        reason = f"{register.name} ({register.address}) is EEPROM, locked while torque is on"
        raise Refusal(ErrorCode.ACCESS, reason)
    if by_shadow_id:
        raise Refusal(ErrorCode.ACCESS, f"{register.name} ({register.address}) is EEPROM, closed to the secondary id")


def _check_goal(table: ControlTable, name: str, value: int) -> None:
    low, high = _goal_range(table, name)
    if not low <= value <= high:
        raise Refusal(ErrorCode.DATA_LIMIT, f"{name} = {value} is outside {low} to {high}")


def _goal_range(table: ControlTable, name: str) -> tuple[int, int]:
    if name == "goal_position":
        if table.get("operating_mode") == Mode.POSITION:
            return table.get("min_position_limit"), table.get("max_position_limit")
        return -EXTENDED_RANGE, EXTENDED_RANGE
    limit = table.get(name.removeprefix("goal_") + "_limit")
    return -limit, limit


def seed_goals(table: ControlTable, position_counts: int) -> None:
    """Goals that ask for no motion. Outside PWM mode, goal PWM is only the limit of the controller."""
    mode = table.get("operating_mode")
    table.set("goal_position", position_counts)
    table.set("goal_velocity", 0)
    table.set("goal_pwm", 0 if mode == Mode.PWM else table.get("pwm_limit"))
    if "goal_current" in table.model.by_name:
        table.set("goal_current", 0 if mode == Mode.CURRENT else table.get("current_limit"))
