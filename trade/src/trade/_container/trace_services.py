"""What every container offers about calls it noted and lines it logged, in group ``trade``."""

from collections.abc import Callable

from msgspec import structs

from trade._services.decorator import service
from trade._telemetry.log_buffer import LogLine, logbook
from trade._telemetry.spans import Span, Spans

Switch = Callable[[bool], bool]


class TraceServices:
    """The wire's side of `Spans` and `Logbook`."""

    def __init__(self, container: str, spans: Spans, switch: Switch) -> None:
        self._teller = container
        self._noted = spans
        self._switch = switch

    @service
    def set_tracing(self, on: bool) -> bool:
        """Note every call that this container makes and serves; off: what was noted stays. Whether it was on before."""
        return self._switch(on)

    @service(effect="read")
    def spans(self, calls: list[int] | None = None, after: int = 0) -> list[Span]:
        """What this container noted above that number, of these calls and those they led to, or all; oldest first."""
        return self._noted.kept(None if calls is None else frozenset(calls), after)

    @service(effect="read")
    def log_lines(self, after: int = 0) -> list[LogLine]:
        """What the process logged lately, of its lines after that one."""
        return [structs.replace(line, container=self._teller) for line in logbook.lines(after)]
