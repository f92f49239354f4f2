"""Records of faults and their samples. No I/O."""

import re
from collections.abc import Sequence
from typing import Any, Final, cast

from msgspec import Struct, structs

_NUMBER: Final = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")
_SEVERAL: Final = re.compile(r"((?:hardware error|error|status): )(.+)")
"""How drivers list the error bits that a device reports, one word for each."""
_TIMES: Final = frozenset({"measured_at", "stamp_ns", "age_s"})

Moment = tuple[float, Any]
"""A time by ``time.monotonic()`` and the state measured then."""


class FaultSample(Struct, frozen=True, kw_only=True):
    """One measurement of a device, as numbers."""

    s: float
    """Time since the fault began; negative before it."""
    values: dict[str, float]
    """Values by their names in ``state()`` or ``read()``: ``position_rad``, ``load``; ``positions_rad.1`` in a list.
    True is 1."""


class FaultInfo(Struct, frozen=True, kw_only=True):
    """One kind of fault of one device, with all its occurrences."""

    id: str
    """Such as ``rosie-3f2a``."""
    device: str
    """Such as ``rosie.neck.pan``."""
    kind: str
    """The text without its numbers; ``silent`` or ``bus gone`` if the device is offline."""
    text: str
    """The text of the latest occurrence, with the device's name."""
    remedy: str = ""
    """What to do; empty if the text says so."""
    open: bool
    """True while the fault is present."""
    first_at: float
    """When the fault first began, in seconds since the epoch."""
    last_at: float
    """When the fault last began."""
    gone_at: float | None = None
    """When the fault ended, if it has. If it ended between two processes, the start of the later one."""
    lasted_s: float = 0.0
    """Total duration of all occurrences, by the monotonic clock."""
    count: int = 1
    """Number of occurrences."""
    acknowledged_by: str = ""
    """The identity that acknowledged the latest occurrence, such as ``page for anna``; empty if none has."""
    acknowledged_at: float | None = None
    evidence: list[str] = []
    """Findings that clients have attached, oldest first."""

    @property
    def summary(self) -> str:
        """The kind with the numbers of the latest occurrence."""
        text = self.text.removeprefix(f"{self.device}: ")
        return text if kind_of(text) == self.kind else self.kind


class Fault(FaultInfo, frozen=True, kw_only=True):
    """A fault with the measurements from before it began."""

    first: list[FaultSample] = []
    """Samples of the first occurrence, oldest first."""
    latest: list[FaultSample] = []
    """Samples of the latest occurrence."""


def info_of(fault: Fault) -> FaultInfo:
    """Returns a fault without its samples."""
    return FaultInfo(**{name: getattr(fault, name) for name in FaultInfo.__struct_fields__})


def kind_of(text: str) -> str:
    """Returns a fault's text without its numbers, so that different distances to a goal are one kind of fault."""
    return _NUMBER.sub("N", text)


def parts_of(text: str) -> list[str]:
    """Splits the text of a device into its faults; several may be present at once, and end separately."""
    several = _SEVERAL.fullmatch(text)
    return [several[1] + part for part in several[2].split(", ")] if several else [text]


def when(state: Any) -> float:
    """Returns when a state or reading was measured, by ``time.monotonic()``; raises TypeError for anything else."""
    if not isinstance(state, Struct):
        raise TypeError(f"{type(state).__name__} is not a state or a reading")
    stamp_ns = getattr(state, "stamp_ns", None)
    return float(state.measured_at if stamp_ns is None else stamp_ns / 1e9)  # type: ignore[attr-defined]


def samples_of(moments: Sequence[Moment], began_s: float) -> list[FaultSample]:
    """Converts measurements to numbers; ``began_s`` is the begin of the fault by ``time.monotonic()``."""
    return [FaultSample(s=round(at_s - began_s, 4), values=_values(state)) for at_s, state in moments]


def _values(state: Any) -> dict[str, float]:
    values: dict[str, float] = {}
    for name, value in structs.asdict(state).items():
        if name in _TIMES:
            continue
        if isinstance(value, int | float):
            values[name] = float(value)
        elif isinstance(value, list):
            numbers = cast("list[float]", value)
            values |= {f"{name}.{place}": number for place, number in enumerate(numbers)}
    return values
