"""Registers of the 2F-85 as data, with their conversion to SI units.

Sources: Robotiq "2F-85 & 2F-140 Instruction Manual", chapter 4 (registers, faults); product sheet (stroke,
speed, force).
"""

from typing import Final

from msgspec import Struct

COMMAND: Final = 0x03E8
"""First of three registers to write: action request, position request, speed and force."""
STATUS: Final = 0x07D0
"""First of three registers to read: gripper status, fault and echo of the position request, position and current."""
COUNT: Final = 3

BAUDS: Final = (9_600, 19_200, 38_400, 57_600, 115_200)
"""Baud rates that the vendor's tool can set."""

_ACTIVATE: Final = 0x01
_GO: Final = 0x08
_RESERVED: Final = 0x06
_ACTIVATING: Final = 1
_ACTIVE: Final = 3
_UNUSED: Final = 2

RESET: Final = (0, 0, 0)
"""Clears faults and activation, and stops everything."""
ACTIVATE: Final = (_ACTIVATE << 8, 0, 0)
"""Directly after a reset, the fingers move through their whole range; later, they stop."""

AMPERE_PER_COUNT: Final = 0.01

_PASSING: Final = frozenset({0x00, 0x05, 0x07, 0x09})
"""Codes that are not faults: waiting for activation, or no request for a second."""
_FAULTS: Final = {
    0x08: "it is too hot; let it cool down",
    0x0A: "its supply voltage is too low",
    0x0B: "its automatic release is in progress",
    0x0C: "internal fault",
    0x0D: "its activation failed; is something in the way of its fingers?",
    0x0E: "overcurrent",
    0x0F: "its automatic release has ended",
}


class Contact:
    """Values of gOBJ while the fingers have a goal."""

    MOVING: Final = 0
    OPENING: Final = 1
    CLOSING: Final = 2
    ARRIVED: Final = 3


class Model(Struct, frozen=True):
    """The properties in which such grippers differ."""

    name: str
    stroke_m: float
    open_counts: int
    closed_counts: int
    """Positions at the end stops; grippers differ by a count or two."""
    speeds_m_s: tuple[float, float]
    forces_n: tuple[float, float]
    """At requests of 0 and of 255."""

    @property
    def m_per_count(self) -> float:
        """Width of one count."""
        return self.stroke_m / (self.closed_counts - self.open_counts)

    def width_m(self, counts: float) -> float:
        """Returns the distance between the fingers, 0 to the stroke."""
        return min(self.stroke_m, max(0.0, (self.closed_counts - counts) * self.m_per_count))

    def counts(self, width_m: float) -> int:
        """Returns the position to request; the full range at its ends, which moves the fingers to their stops."""
        counts = round(self.closed_counts - width_m / self.m_per_count)
        return 0 if counts <= self.open_counts else 255 if counts >= self.closed_counts else counts

    def expected(self, request: int) -> int:
        """Returns the position of the fingers after a request."""
        return min(self.closed_counts, max(self.open_counts, request))

    def speed_counts(self, speed_m_s: float) -> int:
        """Returns the speed to request, rounded down."""
        return _scaled(speed_m_s, self.speeds_m_s)

    def force_counts(self, force_n: float) -> int:
        """Returns the force to request, rounded down."""
        return _scaled(force_n, self.forces_n)


def _scaled(value: float, ends: tuple[float, float]) -> int:
    low, high = ends
    return max(0, min(255, int((value - low) / (high - low) * 255 + 1e-9)))


MODELS: Final = (Model("2F-85", 0.085, 3, 230, (0.020, 0.150), (20.0, 235.0)),)
BY_MODEL_NAME: Final = {model.name: model for model in MODELS}


class Status(Struct, frozen=True, gc=False):
    """The decoded status registers."""

    activating: bool
    activated: bool
    going: bool
    """True if it has a goal: it moves there, or keeps pressing there."""
    contact: int
    """See ``Contact``; only valid with a goal."""
    fault: int
    echo: int
    """The position request that this status answers."""
    position: int
    current: int
    reset: bool
    """True if it is neither activated nor activating."""
    plausible: bool
    """False for values that a 2F-85 never sends."""
    at_ns: int

    @classmethod
    def decode(cls, registers: list[int], at_ns: int) -> "Status":
        """Decodes the registers."""
        first, second, third = registers
        bits, state = first >> 8, first >> 12 & 3
        asked = bool(bits & _ACTIVATE)
        return cls(
            activating=asked and state == _ACTIVATING,
            activated=asked and state == _ACTIVE,
            going=bool(bits & _GO),
            contact=bits >> 6,
            fault=second >> 8 & 0x0F,
            echo=second & 0xFF,
            position=third >> 8,
            current=third & 0xFF,
            reset=not asked and state == 0,
            plausible=not (first & 0xFF or bits & _RESERVED or state == _UNUSED),
            at_ns=at_ns,
        )

    @property
    def under_way(self) -> bool:
        """Whether it reports motion."""
        return self.activating or (self.activated and self.going and self.contact == Contact.MOVING)


def command(position: int, speed: int, force: int, *, go: bool = True) -> tuple[int, int, int]:
    """Returns the registers for an activated gripper; without ``go``, its fingers stop."""
    return (_ACTIVATE | (_GO if go else 0)) << 8, position, speed << 8 | force


def fault_text(fault: int) -> str:
    """Returns the text of a fault code; empty if it is not a fault."""
    return "" if fault in _PASSING else _FAULTS.get(fault, f"fault {fault:#04x}, which the manual does not know")
