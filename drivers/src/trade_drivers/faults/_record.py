"""What is known of a fault. Pure records, no I/O."""

import re
from collections.abc import Sequence
from typing import Any, Final, cast

from msgspec import Struct, structs

__all__ = ["Fault", "FaultInfo", "FaultSample", "Moment", "info_of", "kind_of", "parts_of", "samples_of", "when"]

_NUMBER: Final = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")
_SEVERAL: Final = re.compile(r"((?:hardware error|error|status): )(.+)")
"""How drivers say what a device reports, one word a bit."""
_TIMES: Final = frozenset({"measured_at", "stamp_ns", "age_s"})

Moment = tuple[float, Any]
"""When something was measured, by ``time.monotonic()``, and the state that was."""


class FaultSample(Struct, frozen=True, kw_only=True):
    """What a device measured once."""

    s: float
    """How long after the fault began; negative before."""
    values: dict[str, float]
    """By the names that its ``state()`` or ``read()`` has: ``position_rad``, ``load``; ``positions_rad.1`` of several.
    What is true is 1."""


class FaultInfo(Struct, frozen=True, kw_only=True):
    """One kind of fault of one device, however often it was there."""

    id: str
    """Such as ``rosie-3f2a``."""
    device: str
    """Such as ``rosie.neck.pan``."""
    kind: str
    """Its text without what differs from time to time; ``silent`` and ``bus gone`` if the device cannot be heard."""
    text: str
    """What was wrong the latest time, with the device's name."""
    remedy: str = ""
    """What to do; empty if the text says it."""
    open: bool
    """It is there now. False: it is gone."""
    first_at: float
    """When it began the first time, in seconds since the epoch."""
    last_at: float
    """When it began the latest time."""
    gone_at: float | None = None
    """When it ended, if it has; found open by a new process that does not see it, when that process began."""
    lasted_s: float = 0.0
    """How long it was there in all, by a clock that nobody sets."""
    count: int = 1
    """How often it began."""
    acknowledged_by: str = ""
    """Who has seen it since it began the latest time: an identity, ``page for anna`` by a door; empty: nobody."""
    acknowledged_at: float | None = None
    evidence: list[str] = []
    """What others have found out about it, oldest first."""

    @property
    def said(self) -> str:
        """What was wrong the latest time, in few words: its kind, with the numbers that it had then."""
        text = self.text.removeprefix(f"{self.device}: ")
        return text if kind_of(text) == self.kind else self.kind


class Fault(FaultInfo, frozen=True, kw_only=True):
    """The same, with what was measured before it began."""

    first: list[FaultSample] = []
    """The first time, oldest sample first."""
    latest: list[FaultSample] = []
    """The latest time."""


def info_of(fault: Fault) -> FaultInfo:
    """A fault without its samples."""
    return FaultInfo(**{name: getattr(fault, name) for name in FaultInfo.__struct_fields__})


def kind_of(text: str) -> str:
    """A fault's text without its numbers: how far a joint was short of its goal does not make it another fault."""
    return _NUMBER.sub("N", text)


def parts_of(text: str) -> list[str]:
    """The faults that a device reports in one text: several may be there at once, and end one by one."""
    several = _SEVERAL.fullmatch(text)
    return [several[1] + part for part in several[2].split(", ")] if several else [text]


def when(state: Any) -> float:
    """When a state or reading was measured, by ``time.monotonic()``; TypeError if it is neither."""
    if not isinstance(state, Struct):
        raise TypeError(f"{type(state).__name__} is no record of what was measured")
    stamp_ns = getattr(state, "stamp_ns", None)
    return float(state.measured_at if stamp_ns is None else stamp_ns / 1e9)  # type: ignore[attr-defined]


def samples_of(moments: Sequence[Moment], began_s: float) -> list[FaultSample]:
    """What was measured, as numbers; ``began_s`` is when the fault began, by ``time.monotonic()``."""
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
