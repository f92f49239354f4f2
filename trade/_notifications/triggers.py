"""Triggers of notifications: an event, a call to make, and conditions. Plain data that can be sent."""

import inspect
import math
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from typing import Any, Final, Literal, cast

from msgspec import Struct

from trade._calls.handle import BoundCall, Handle
from trade._notifications.events import EVENT_KINDS
from trade._registry.constraints import Constraint, as_constraint, service_at
from trade.errors import ConfigurationError

Trigger = Literal["joined", "left", "changed", "once", "after", "at", "every", "occurred"]
OF_SERVICES: Final = frozenset({"joined", "left", "changed"})
OF_CHANGES: Final = OF_SERVICES | {"occurred"}
"""The events that their calls get as an argument: the service, or the event."""

SHORTEST_S: Final = 0.001
_YEAR_10000_S: Final = 253_402_300_800
"""In seconds since 1970."""
LONGEST_S: Final = 10 * 366 * 86_400.0


class Action(Struct, frozen=True):
    """A call that can be sent: of a service, or of the only one that matches at that time."""

    handle: Handle | None = None
    constraint: Constraint | None = None
    args: tuple[Any, ...] = ()
    kwargs: dict[str, Any] = {}

    def __str__(self) -> str:
        given = ", ".join([*map(repr, self.args), *(f"{name}={value!r}" for name, value in self.kwargs.items())])
        if self.handle is not None:
            return f"{self.handle.label}({given})"
        return f"the service with {self.constraint}"


What = Callable[..., Any] | Handle | BoundCall | Constraint | str
"""The target of a call: a handle, a bound call, a service by a constraint or as text, or a function of this process."""
Target = Action | Callable[..., Any]


class TriggerSpec(Struct, frozen=True, kw_only=True):
    """The event of a notification."""

    occasion: Trigger
    constraint: Constraint | None = None
    """The services of joined, left and changed; those that an event is about."""
    events: tuple[str, ...] = ()
    """The kinds of events of occurred."""
    existing: bool = False
    s: float = 0.0
    at: float = 0.0
    """Seconds since the epoch."""
    poll_s: float = 1.0
    """How often ``when`` is checked."""
    edge: bool = False

    def check(self) -> None:
        """Raises ConfigurationError: an invalid time."""
        if self.occasion in OF_SERVICES and self.constraint is None:
            raise ConfigurationError(where=f"trade.{self.occasion}", problem="say which services, with where(...)")
        if self.occasion == "occurred" and (not self.events or not EVENT_KINDS.issuperset(self.events)):
            problem = f"{', '.join(self.events) or 'no event'} is not among {', '.join(sorted(EVENT_KINDS))}"
            raise ConfigurationError(where="trade.occurred", problem=problem)
        if self.occasion == "every":
            _check_s(self.occasion, "s", self.s, SHORTEST_S)
        elif self.occasion == "after":
            _check_s(self.occasion, "s", self.s, 0.0)
        elif self.occasion == "at" and not 0 <= self.at < _YEAR_10000_S:
            raise ConfigurationError(where="trade.at", problem=f"{self.at!r} s since 1970 is not a valid time")
        _check_s(self.occasion, "poll_s", self.poll_s, SHORTEST_S)

    def __str__(self) -> str:
        match self.occasion:
            case "every" | "after":
                return f"{self.occasion} {self.s:g} s"
            case "at":
                return f"at {datetime.fromtimestamp(self.at, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"
            case "once":
                return "once"
            case "occurred":
                return f"{', '.join(self.events)}{'' if self.constraint is None else f' of {self.constraint}'}"
            case _:
                return f"{self.occasion} {self.constraint}"


def _check_s(occasion: str, name: str, value: float, least: float) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)  # pyright: ignore[reportUnnecessaryIsInstance]
    if not number or not math.isfinite(value) or not least <= value <= LONGEST_S:
        problem = f"{name} must be seconds, from {least:g} to {LONGEST_S:.0f} (ten years), not {value!r}"
        raise ConfigurationError(where=f"trade.{occasion}", problem=problem)


def epoch_s(moment: datetime, now_s: float) -> float:
    """A time as seconds since the epoch.

    Raises:
        ConfigurationError: it has passed, or has no time zone.
    """
    if not isinstance(moment, datetime):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ConfigurationError(where="trade.at", problem=f"the time must be a datetime, not {moment!r}")
    if moment.tzinfo is None or moment.utcoffset() is None:
        problem = f"{moment} has no time zone; {moment!r}.astimezone() adds that of this computer"
        raise ConfigurationError(where="trade.at", problem=problem)
    if moment.timestamp() <= now_s:
        ago_s = now_s - moment.timestamp()
        raise ConfigurationError(where="trade.at", problem=f"{moment} has passed, {ago_s:.1f} s ago")
    return moment.timestamp()


def target_of(what: What, where: str, argument: str, given: int) -> Target:
    """The target of a call, as data if possible.

    Args:
        what: a service, a bound call, a constraint or a function.
        where: the caller's function, for the error.
        argument: the name of the argument, for the error.
        given: the number of values that it is called with.

    Raises:
        ConfigurationError: it cannot be called, or not with this number of values.
    """
    if isinstance(what, Handle):
        return Action(handle=cast("Handle", what))
    if isinstance(what, BoundCall):
        return Action(handle=what.handle, args=what.args, kwargs=dict(what.kwargs))
    if isinstance(what, Constraint | str):
        return Action(constraint=as_constraint(what, where, service_at))
    if callable(what):
        _check_takes(what, where, argument, given)
        return what
    problem = f"{argument} must be a handle, a bound call, where(...), a function, or a text such as 'rosie.head.stop'"
    problem += f", not {what!r}"
    raise ConfigurationError(where=where, problem=problem)


def _check_takes(function: Callable[..., Any], where: str, argument: str, given: int) -> None:
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # a C function: only a call shows that
        return
    try:
        signature.bind(*range(given))
    except TypeError as bad:
        values = {0: "without arguments", 1: "with one argument"}[given]
        problem = f"{argument} is called {values}, and {text_of(function)} takes {signature}: {bad}"
        raise ConfigurationError(where=where, problem=problem) from None


def action_of(target: Target, host: str, where: str) -> Action:
    """The target for another container. Raises ConfigurationError: that one cannot call a function of this process."""
    if isinstance(target, Action):
        return target
    problem = (
        f"{host} cannot call {target!r}, a function of this process; "
        "make it a service (@service, trade.register) and give its handle"
    )
    raise ConfigurationError(where=where, problem=problem)


def text_of(target: Target) -> str:
    """The target as text. Methods of the middleware's own objects are described by the object's ``target_text``."""
    if isinstance(target, Action):
        return str(target)
    target_text: str = getattr(getattr(target, "__self__", None), "target_text", "")
    if target_text:
        return target_text
    owner: Mapping[str, Any] | Any = getattr(target, "__qualname__", None)
    return f"{owner or repr(target)} (a function)"
