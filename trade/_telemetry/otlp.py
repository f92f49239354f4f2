"""Exports spans to a collector over OTLP/HTTP, such as Jaeger or Tempo: an extra, off by default."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from hashlib import blake2b
from typing import TYPE_CHECKING, Final

from trade._settings import Settings
from trade._telemetry.spans import Span
from trade.errors import ConfigurationError
from trade.protocol.keys import Address

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import SpanProcessor

INSTALL: Final = 'needs OpenTelemetry; pip install "trade-core[otel]"'
_ASKED: Final = 1 << 63
"""Call ids are below it: the caller's span of a call has the call's id with this bit as its span id."""
_MOST: Final = 2048
"""The largest number of waiting spans; while the collector is unreachable the newest are lost."""
_TIMEOUT_S: Final = 2.0
_NS: Final = 1_000_000_000


class Export:
    """Converts spans to OpenTelemetry's and exports them; never waits for a collector.

    The trace id is derived from the outermost call's id; a served call has its own id as span id.

    Args:
        processor: of OpenTelemetry's SDK; closed with this object.
        about: attributes of the container that records the spans.
    """

    def __init__(self, processor: "SpanProcessor", about: Mapping[str, str]) -> None:
        from opentelemetry.sdk.resources import Resource  # noqa: PLC0415 - an extra
        from opentelemetry.sdk.util.instrumentation import InstrumentationScope  # noqa: PLC0415

        self._processor = processor
        self._resource = Resource.create(dict(about))
        self._scope = InstrumentationScope("trade")

    def tell(self, span: Span) -> None:
        """Export a span."""
        from opentelemetry.sdk.trace import Event, ReadableSpan  # noqa: PLC0415
        from opentelemetry.trace import SpanContext, SpanKind, Status, StatusCode, TraceFlags  # noqa: PLC0415

        def named(span_id: int, *, remote: bool) -> SpanContext:
            return SpanContext(trace_id(span.ids[-1]), span_id, remote, TraceFlags(TraceFlags.SAMPLED))

        asked, failed = span.side == "asked", span.outcome != "ok"
        kind = SpanKind.CLIENT if asked else SpanKind.SERVER if span.remote else SpanKind.INTERNAL
        own, parent = span_ids(span)
        began_ns = round(span.began * _NS)
        self._processor.on_end(
            ReadableSpan(
                name=span.service,
                context=named(own, remote=False),
                parent=named(parent, remote=span.remote) if parent else None,
                resource=self._resource,
                attributes={
                    "trade.call_id": str(span.call_id),
                    "trade.caller": span.caller,
                    "trade.session": span.session,
                    "trade.waited_s": span.waited_s,
                    "trade.locks": span.locks,
                },
                events=[Event(text, timestamp=began_ns + round(after_s * _NS)) for after_s, text in span.events],
                kind=kind,
                status=Status(StatusCode.ERROR, span.outcome) if failed else Status(StatusCode.UNSET),
                start_time=began_ns,
                end_time=began_ns + round(span.took_s * _NS),
                instrumentation_scope=self._scope,
            )
        )

    def close(self) -> None:
        """Send waiting spans, for a few seconds at most."""
        self._processor.shutdown()


def trace_id(call_id: int) -> int:
    """The trace id of an outermost call, the same in every container: all 128 bits look random, as samplers expect."""
    return int.from_bytes(blake2b(call_id.to_bytes(8, "big"), digest_size=16).digest(), "big")


def span_ids(span: Span) -> tuple[int, int]:
    """The span id, and the parent's, 0 for none: the call around it or, for a remote call, the caller's span."""
    led = span.calls[0] if span.calls else 0
    if span.side == "asked":
        return span.call_id | _ASKED, led
    return span.call_id, span.call_id | _ASKED if span.remote else led


def open_export(settings: Settings, own: Address, leaving: ExitStack) -> Callable[[Span], None] | None:
    """The receiver of spans if they are to be exported to a collector; its closing goes onto the stack.

    Raises:
        ConfigurationError: the extra is not installed.
    """
    if not settings.otlp:
        return None
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter  # noqa: PLC0415
        from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415
    except ImportError:
        raise ConfigurationError(where="TRADE_OTLP", problem=INSTALL) from None
    exporter = OTLPSpanExporter(endpoint=f"{settings.otlp.rstrip('/')}/v1/traces", timeout=_TIMEOUT_S)
    processor = BatchSpanProcessor(exporter, max_queue_size=_MOST, max_export_batch_size=_MOST)
    names = {"service.name": own.container, "service.namespace": settings.system, "service.instance.id": own.epoch}
    export = Export(processor, names)
    leaving.callback(export.close)
    return export.tell
