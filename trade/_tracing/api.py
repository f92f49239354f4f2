"""The tracing methods of a container: spans and log lines of the whole system."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Final, Protocol

from msgspec import Struct

from trade._calls.batch import Outcome
from trade._calls.client import CallClient
from trade._calls.everywhere import Everywhere, answers
from trade._calls.handle import BoundCall, Handle
from trade._telemetry.log_buffer import LogLine
from trade._telemetry.spans import Span
from trade.errors import NoSuchCall
from trade.protocol.keys import Address, ServiceKey

NOT_TRACED: Final = "(not traced)"


class Trace(Struct, frozen=True, kw_only=True):
    """The trace of a call, and of the calls that it led to."""

    call_id: int
    asked: Span | None
    """The caller's span; None if the caller was in the same container, or is not traced."""
    served: Span | None
    """The callee's span; None if it is not traced, or the call never ran."""
    lines: tuple[LogLine, ...]
    """The log lines while it ran."""
    calls: tuple["Trace", ...]
    """The calls that it made, in order."""

    @property
    def spans(self) -> tuple[Span, ...]:
        """Its known spans, the caller's first."""
        return tuple(span for span in (self.asked, self.served) if span is not None)

    @property
    def service(self) -> str:
        """The called service; ``(not traced)`` if only the calls that it led to are known."""
        return next((span.service for span in self.spans), NOT_TRACED)

    @property
    def began(self) -> float:
        """Its start, by ``time.time()`` of the host that recorded it."""
        return next((span.began for span in self.spans), None) or min((call.began for call in self.calls), default=0.0)


class SystemLookup(Protocol):
    """Finds and calls services of the system, as a container does."""

    def everywhere(self, name: str, *, container: str = "*") -> Everywhere: ...
    def call_all(self, which: Iterable[Handle | BoundCall], /) -> list[Outcome]: ...


class LogReader:
    """Reads the log lines of the system, each one once."""

    def __init__(self, lookup: SystemLookup, container: str) -> None:
        self._lookup = lookup
        self._container = container
        self._silent = set[Address]()
        """The containers that the last reading missed: the log names them once."""
        self._read: dict[ServiceKey, int] = {}
        self._known: dict[str, int] = {}
        """The last returned line of each process."""

    def read(self) -> list[LogLine]:
        """The lines since the last reading, in order of time by the clocks of their hosts.

        Those of one process keep their order, also if its clock was set back between them.

        Raises:
            AccessDenied: the policy does not let this container read group ``trade``.
        """
        present = self._lookup.everywhere("log_lines", container=self._container)
        outcomes = self._lookup.call_all([handle.bind(self._read.get(handle.key, 0)) for handle in present.handles])
        named, self._silent = self._silent, set(present.silent)
        new: dict[tuple[str, int], LogLine] = {}
        for outcome in answers("log_lines", outcomes, sorted(self._silent - named, key=str)):
            lines: list[LogLine] = outcome.result
            if lines:
                self._read[outcome.handle.key] = lines[-1].number
            for line in lines:
                if line.number > self._known.get(line.process, 0):
                    new.setdefault((line.process, line.number), line)
        for process, number in new:
            self._known[process] = max(number, self._known.get(process, 0))
        return _in_order(new.values())


def _in_order(lines: Iterable[LogLine]) -> list[LogLine]:
    latest: dict[str, float] = {}
    placed: list[tuple[float, str, int, LogLine]] = []
    for line in sorted(lines, key=lambda line: (line.process, line.number)):
        at = latest[line.process] = max(line.at, latest.get(line.process, line.at))
        placed.append((at, line.process, line.number, line))
    return [line for *_, line in sorted(placed, key=lambda one: one[:3])]


class TraceApi:
    """The spans and log lines of all containers."""

    def __init__(self, client: CallClient) -> None:
        self._client = client

    def set_tracing(self, on: bool, *, container: str = "*") -> list[str]:
        """Switches the tracing of all calls that containers make and serve on or off; earlier spans stay.

        Each container keeps its newest 10,000 spans. This does not affect containers that start later; `TRADE_TRACE=1`
        does.

        Args:
            on: whether to trace.
            container: which; ``*`` and ``?`` match anything.

        Returns:
            The names of the containers that were switched.

        Raises:
            AccessDenied: the policy does not let this container ``instrument`` group ``trade``.
        """
        outcomes = self._client.call_everywhere("set_tracing", on, container=container)
        return sorted(outcome.handle.container for outcome in outcomes)

    def spans(self, *, container: str = "*") -> list[Span]:
        """The spans that the containers recorded while they were traced, by time.

        Raises:
            AccessDenied: the policy does not let this container ``read`` group ``trade``.
        """
        return self._spans_of(None, container)

    def trace(self, call_id: int) -> Trace:
        """The whole tree of a call, from all containers, with its log lines.

        Times are of each host's wall clock, so they are comparable only as far as these clocks agree.

        Raises:
            NoSuchCall: no container has recorded it, or it was dropped since.
            AccessDenied: the policy does not let this container ``read`` group ``trade``.
        """
        wanted, asked_for, spans = {call_id}, set[int](), list[Span]()
        while wanted - asked_for:  # a hook's call knows the observed call, but not the calls that led to it
            asked_for = set(wanted)
            spans = self._spans_of(sorted(wanted), "*")
            wanted.update(*(span.ids for span in spans))
        if not spans:
            raise NoSuchCall(id=call_id)
        return _tree(spans, self.logs())

    def logs(self, *, container: str = "*") -> list[LogLine]:
        """The recent lines of the logger ``trade`` in all processes of the system, by the clocks of their hosts.

        Each process keeps its newest 2,000 lines of its log level.

        Raises:
            AccessDenied: the policy does not let this container ``read`` group ``trade``.
        """
        return LogReader(self._client, container).read()

    def _spans_of(self, calls: Sequence[int] | None, container: str) -> list[Span]:
        outcomes = self._client.call_everywhere("spans", calls, container=container)
        return sorted(itertools.chain.from_iterable(one.result for one in outcomes), key=_when)


def _when(span: Span) -> tuple[float, int]:
    return span.began, span.call_id


def _tree(spans: Sequence[Span], lines: Iterable[LogLine]) -> Trace:
    """The tree of these spans, which share an outermost call."""
    known: dict[int, dict[str, Span]] = {}
    for span in spans:
        known.setdefault(span.call_id, {}).setdefault(span.side, span)
    logged: dict[int, list[LogLine]] = {}
    for line in lines:
        logged.setdefault(line.call_id, []).append(line)
    children: dict[int, list[int]] = {}
    tops: list[int] = []
    for call_id, sides in known.items():
        calls = max((span.calls for span in sides.values()), key=len)
        parent = next((one for one in calls if one in known), calls[-1] if calls else None)
        if parent is None:
            tops.append(call_id)
        else:
            children.setdefault(parent, []).append(call_id)
            if parent not in known and parent not in tops:
                tops.append(parent)

    def node(call_id: int) -> Trace:
        sides = known.get(call_id, {})
        calls = sorted(map(node, children.get(call_id, ())), key=lambda call: (call.began, call.call_id))
        served, asked = sides.get("served"), sides.get("asked")
        return Trace(
            call_id=call_id, asked=asked, served=served, lines=tuple(logged.get(call_id, ())), calls=tuple(calls)
        )

    return node(tops[0])
