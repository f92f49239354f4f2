"""The services for spans and log lines that every container offers, in group ``trade``."""

from collections.abc import Callable

from msgspec import structs

from trade._services.decorator import service
from trade._telemetry.log_buffer import LogLine, logbook
from trade._telemetry.spans import Span, Spans


class TraceServices:
    """Switches the tracing of this container, and gives its spans and the log lines of its process."""

    def __init__(self, container: str, spans: Spans, switch: Callable[[bool], bool]) -> None:
        self._container = container
        self._spans = spans
        self._switch = switch

    @service
    def set_tracing(self, on: bool) -> bool:
        """Traces every call that this container makes and serves, or stops that. Returns whether it was on."""
        return self._switch(on)

    @service(effect="read")
    def spans(self, calls: list[int] | None = None, after: int = 0) -> list[Span]:
        """The spans after that number, of these calls and those they led to, or of all; oldest first."""
        return self._spans.kept(None if calls is None else frozenset(calls), after)

    @service(effect="read")
    def log_lines(self, after: int = 0) -> list[LogLine]:
        """The recent log lines of the process after that one."""
        return [structs.replace(line, container=self._container) for line in logbook.lines(after)]
