"""What devices say about themselves that can differ from the robot file (S23), and what the driver says then.

For a question that has no difference, the reason is that of the device's row in docs/drivers.md.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from trade_hil_sim import BrownOut, WrongModel
from trade_hil_sim.cia402 import factor_objects, unit_objects

__all__ = ["DIFFERENCES", "QUESTIONS", "Difference"]

FIRST: Final = 1
QUESTIONS: Final = ("scale", "units", "range", "zero")
_METRES_PER_MIN: Final = 0x00014700
_WIDER: Final = (("min_rad = -1.0\nmax_rad = 1.0", "min_rad = -0.5\nmax_rad = 4.2"),)


class Difference(NamedTuple):
    """One answer of a device that is not what the robot file says."""

    make: Callable[[Any], object]
    """Makes the first device of a simulated bus say so, also after it has lost power."""
    says: Sequence[str]
    """Parts of the refusal: both numbers."""
    loss: BrownOut = BrownOut(ids=(FIRST,))
    """How the device loses its power."""
    changes: Sequence[tuple[str, str]] = ()
    """Of the robot file."""
    at_rad: float = 0.0
    """Where the joint is."""


def _first(sim: Any) -> Any:
    return next(device for device in sim.devices if device.device_id == FIRST)


def _keeps(**values: int) -> Callable[[Any], object]:
    """Registers of a servo that outlast a loss of power."""

    def make(sim: Any) -> None:
        memory = _first(sim).memory
        for name, value in values.items():
            memory.set(name, value)
            if hasattr(memory, "keep"):
                memory.keep(name)

    return make


def _says(*objects: Any) -> Callable[[Any], object]:
    return lambda sim: _first(sim).says(*objects)


def _is_set_to(position_rad: int) -> Callable[[Any], object]:
    return lambda sim: sim.do(WrongModel(ids=(FIRST,), number=position_rad))


def _nothing(_: Any) -> None:
    """The loss of power is what shifts it."""


def _limited(sim: Any) -> None:
    _first(sim).store.set("position_limit_min", -1000)


DIFFERENCES: Final[Mapping[str, Mapping[str, Difference | str]]] = {
    "dynamixel": {
        "scale": Difference(_keeps(drive_mode=1), ("counts in the other direction by itself", "reversed = ")),
        "units": Difference(_keeps(drive_mode=4), ("drive mode (register 10) is 4; set it to 0",)),
        "range": Difference(
            _keeps(min_position_limit=2000), ("min_rad -1.4 to max_rad 1.4", "-0.0736", "registers 52 and 48")
        ),
        "zero": Difference(_keeps(homing_offset=100), ("homing offset (register 20) is 100", "0 in the robot file")),
    },
    "feetech": {
        "scale": Difference(_keeps(phase=13), ("in the other direction by itself", "reversed = ")),
        "units": Difference(_keeps(phase=8), ("phase (register 18) is 8", "set bit 2")),
        "range": Difference(_keeps(min_angle=2000, max_angle=4000), ("min_rad -1.4 to max_rad 1.4", "-0.0736")),
        "zero": Difference(_keeps(homing_offset=-100), ("homing offset (register 31) is -100", "0 in the robot file")),
    },
    "cia402": {
        "scale": Difference(_says(*factor_objects(encoder=(1024, 1))), ("4096 counts", "1024 (608Fh = 1024/1)")),
        "units": Difference(_says(*unit_objects(velocity=_METRES_PER_MIN)), ("its unit m/min",)),
        "range": Difference(_limited, ("min_rad -1 to max_rad 1", "drive's own range (607Dh)")),
        "zero": Difference(
            _nothing, ("reports 0.000 rad", "0.900 rad"), BrownOut(ids=(FIRST,), zero="lost"), at_rad=0.9
        ),
    },
    "odrive": {
        "scale": "cannot be compared: CANSimple does not report the scale of positions",
        "units": "cannot happen: CANSimple has turns, turns/s and turns/s² only",
        "range": "it has no limits of position",
        "zero": Difference(
            _nothing, ("reports 0.000 rad", "0.900 rad"), BrownOut(ids=(FIRST,), zero="lost"), at_rad=0.9
        ),
    },
    "damiao": {
        "scale": Difference(_is_set_to(20), ("goes to 12.5", "is set to 20 (register 21)")),
        "units": "registers 21 to 23 scale them",
        "range": "cannot happen: it has no limits but the ends of its scale",
        "zero": Difference(
            _nothing,
            ("reports -2.68", "3.600 rad"),
            BrownOut(ids=(FIRST,), zero="turn"),
            _WIDER,
            3.6,
        ),
    },
    "robotiq": {
        "scale": "cannot happen: the file has no factor",
        "units": "cannot happen: 0 to 255 for the whole range of each value",
        "range": "cannot happen: its range ends where its fingers do",
        "zero": "its zero is found by the activation, without which it does not move",
    },
    "ur": {
        "scale": "cannot happen: the file has no factor",
        "units": "cannot happen: the controller has rad, rad/s and rad/s² only",
        "range": "its controller stops the arm itself, and that is a fault",
        "zero": "cannot happen unseen: its encoders are absolute",
    },
}
