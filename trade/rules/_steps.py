"""Runs or rehearses the steps of a rule, and detects rules that fire each other in a loop."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from msgspec import Struct

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade.errors import ConfigurationError
from trade.rules._file import SERVICE, Condition, Selection, Step, filled

AFTERMATH_NS: Final = 5_000_000_000
"""The time within which the effects of steps appear."""
TURNS: Final = 3
"""The number of times that a rule may be among the causes of its own firing."""
_MOST: Final = 1000
_LONGEST: Final = 64


class RuleMark(NamedTuple):
    """A rule, and the service it fired for, if any."""

    rule: str
    service: str = ""


Way = tuple[RuleMark, ...]
"""The causes of a firing, the first one first; it ends with the firing itself."""


class FiringProgress:
    """A firing that is running or over."""

    def __init__(self, way: Way) -> None:
        self.way: Final = way
        self.ended_ns: int | None = None


class LoopDetector:
    """Remembers the latest firings of all rules of an engine."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._past: deque[FiringProgress] = deque(maxlen=_MOST)

    def begin(self, way: Way) -> FiringProgress:
        """A rule fires; the caller sets ``ended_ns`` at its end."""
        past = FiringProgress(way)
        with self._lock:
            self._past.append(past)
        return past

    def forget(self, rule: str) -> None:
        """Forgets the firings of a rule that starts again, so that they no longer count as causes."""
        with self._lock:
            kept = [past for past in self._past if all(mark.rule != rule for mark in past.way)]
            self._past = deque(kept, maxlen=_MOST)

    def way_to(self, mark: RuleMark, since_ns: int) -> Way:
        """The possible causes of an event between two times, followed by the event."""
        with self._lock:
            latest = list(reversed(self._past))
        ways = [past.way for past in latest if past.ended_ns is None or past.ended_ns + AFTERMATH_NS >= since_ns]
        before = max(ways, key=lambda way: way.count(mark), default=())
        return (*before, mark)[-_LONGEST:]


def turns(way: Way) -> int:
    """How often the last mark of a way occurs in it before."""
    return way[:-1].count(way[-1]) if way else 0


_LONGEST_RESULT: Final = 200


class StepResult(Struct, frozen=True, kw_only=True):
    """The result of one step. Arguments are not repeated: they are in the file, and may be secret."""

    step: str
    service: str = ""
    """The service that was called, or waited for."""
    container: str = ""
    result: str = ""
    error: str = ""
    """Type and message of the error."""


class Firing(Struct, frozen=True, kw_only=True):
    """A rule that fired, or was stopped instead."""

    rule: str
    occasion: str
    service: str = ""
    """The service of the event, if any."""
    at: float
    """Seconds since the epoch."""
    took_s: float = 0.0
    steps: tuple[StepResult, ...] = ()
    led_by: tuple[str, ...] = ()
    """Rules that may have caused it, the first cause first."""
    dry_run: bool = False
    """Whether it only reports the calls, without making them."""
    stopped: str = ""
    """Why it no longer fires."""

    @property
    def ok(self) -> bool:
        """Whether every step succeeded."""
        return not self.stopped and not any(did.error for did in self.steps)


def fired(rule: str, occasion: str, service: Handle | None, way: Way, *, dry_run: bool, stopped: str = "") -> Firing:
    """A firing that begins now."""
    return Firing(
        rule=rule,
        occasion=occasion,
        service=service.label if service is not None else "",
        at=time.time(),
        led_by=tuple(mark.rule for mark in way[:-1]),
        dry_run=dry_run,
        stopped=stopped,
    )


def done(client: CallClient, steps: Sequence[Step], service: Handle | None, *, dry_run: bool) -> tuple[StepResult, ...]:
    """Run steps one after the other, up to one that fails; after that, only those with ``always``.

    In a dry run each step is checked, and nothing is called.
    """
    do: Callable[[CallClient, Step, Handle | None], StepResult] = _rehearse if dry_run else _do
    all_done: list[StepResult] = []
    failed = False
    for step in steps:
        if failed and not step.always:
            continue
        try:
            did = do(client, step, service)
        except Exception as error:  # noqa: BLE001 - every error of a service is recorded
            did, failed = StepResult(step=str(step), error=f"{type(error).__name__}: {error}"), not dry_run
        all_done.append(did)
    return tuple(all_done)


def _do(client: CallClient, step: Step, service: Handle | None) -> StepResult:
    if step.wait_for is not None:
        found = client.find(step.wait_for.constraint(service), wait_s=step.s)
        return StepResult(step=str(step), service=found.label, container=found.container)
    handle = _called(client, step, service)
    result = _call(handle.with_(deadline_s=step.deadline_s), step.args, service)
    text = repr(result)[:_LONGEST_RESULT]
    return StepResult(step=str(step), service=handle.label, container=handle.container, result=text)


def _rehearse(client: CallClient, step: Step, service: Handle | None) -> StepResult:
    if step.wait_for is not None:
        found = client.services(step.wait_for.constraint(service))
        there = found[0] if found else None
        return StepResult(
            step=str(step),
            service=there.label if there else "",
            container=there.container if there else "",
            result="exists" if there else "would wait for it",
        )
    handle = _called(client, step, service)
    client.require_call(client.address.identity, handle)
    return StepResult(step=str(step), service=handle.label, container=handle.container, result="would be called")


def _called(client: CallClient, step: Step, service: Handle | None) -> Handle:
    if step.call == SERVICE:
        assert service is not None  # noqa: S101 - checked with the file
        return service
    assert isinstance(step.call, Selection)  # noqa: S101
    return client.find(step.call.constraint(service), wait_s=0, pick=step.pick)


def _call(handle: Handle, args: list[Any] | dict[str, Any], service: Handle | None) -> Any:
    given = filled(args, service)
    return handle(**given) if isinstance(given, dict) else handle(*given)


def holds(client: CallClient, condition: Condition | None, service: Handle | None) -> tuple[bool, Handle | None]:
    """Whether a rule's condition holds, and the service for its steps: the event's, else the condition's.

    Raises the errors of finding and calling the service.
    """
    if condition is None:
        return True, service
    handle = client.find(condition.service.constraint(service), wait_s=0)
    if handle.effect != "read":
        problem = f"{handle.label} does not only read, so it is no condition"
        raise ConfigurationError(where=str(condition), problem=problem)
    return condition.holds(_call(handle, condition.args, service)), handle if service is None else service
