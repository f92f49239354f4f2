"""A servo's own shift of its zero, which is to be what it was when the joint was calibrated."""

from typing import TYPE_CHECKING, Any

from trade.errors import WrongDevice
from trade_drivers.joints.serial._asking import tried

if TYPE_CHECKING:
    from trade_drivers.joints import Steps
    from trade_drivers.joints.serial._axis import ServoAxis
    from trade_drivers.joints.serial._cycle import ServoExchange

__all__ = ["check_homing", "still_homed"]


def zero_moved(axis: "ServoAxis[Any]", found: int) -> str:
    """What is wrong with a homing offset; empty if it is the one that the robot file was calibrated with."""
    expected = axis.joint.homing_counts
    if found == expected:
        return ""
    where = f"its homing offset (register {axis.homing.address})"
    return f"{where} is {found}, but {expected} in the robot file: its zero has moved"


def check_homing(axis: "ServoAxis[Any]", settings: bytes, key: str) -> None:
    """Raises ``WrongDevice`` for a servo whose zero is another one; its registers are given from address 0 on."""
    found = axis.homing.decode(settings, 0)
    if problem := zero_moved(axis, found):
        expected = str(axis.joint.homing_counts)
        raise WrongDevice(where=key, key="homing_counts", expected=expected, found=str(found), problem=problem)


def still_homed(bus: "ServoExchange[Any, Any]", axis: "ServoAxis[Any]") -> "Steps":
    """The same, asked now: a servo may have lost with its power what was not kept, or be another one by now.

    Raises:
        DeviceFault: its zero has moved.
    """
    register = axis.homing
    answer = yield from tried(bus, axis, lambda: bus.wire.read(axis.id, register.address, register.size))
    if problem := zero_moved(axis, register.decode(answer.data, register.address)):
        raise axis.faulty(f"{problem}; write {axis.joint.homing_counts} there again, or `trade calibrate` it")
