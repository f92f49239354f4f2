"""``/metrics`` for Prometheus: an extra, off by default. All values are read at each request."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from itertools import accumulate
from socket import socket
from typing import TYPE_CHECKING, Final, cast

from trade._counters import BOUNDS_S, CallCounters, Measure
from trade._settings import Settings
from trade.errors import ConfigurationError
from trade.transport.bounded_listener import BoundedListener
from trade.transport.endpoints import Endpoint

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

INSTALL: Final = 'needs prometheus-client; pip install "trade-core[metrics]"'
_PREFIX: Final = "trade_"
_MOST_CONNECTIONS: Final = 32
"""The most simultaneous connections; each has a thread until it is answered."""
_BACKLOG: Final = 128
"""Connections that wait to be accepted. The default of 5 makes a scraper wait seconds while strangers connect."""
_ASKED_WITHIN_S: Final = 5.0
"""How long a connection may send nothing."""


class Metrics:
    """A collector of prometheus-client.

    Args:
        container: a label of all metrics.
        calls: counters of calls.
        measures: all other values.
    """

    def __init__(self, container: str, calls: CallCounters, measures: Callable[[], Iterable[Measure]]) -> None:
        self._container = container
        self._calls = calls
        self._measures = measures

    def collect(self) -> "Iterator[Metric]":
        """All metrics with their current values."""
        from prometheus_client.core import (  # noqa: PLC0415 - an extra
            CounterMetricFamily,
            GaugeMetricFamily,
            HistogramMetricFamily,
        )

        names = ("container", "service")
        took = HistogramMetricFamily(f"{_PREFIX}call_seconds", "How long services took, hooks included.", labels=names)
        failed = CounterMetricFamily(f"{_PREFIX}call_failures", "Calls that ended with an error.", labels=names)
        for label, timed in sorted(self._calls.timed().items()):
            counts = list(timed.counts)
            if not any(counts):
                continue
            buckets = zip((*map(str, BOUNDS_S), "+Inf"), accumulate(counts), strict=True)
            took.add_metric((self._container, label), list(buckets), timed.sum_ns / 1e9)
            failed.add_metric((self._container, label), timed.failures)
        refused = CounterMetricFamily(
            f"{_PREFIX}refusals", "Refused calls, by the type of the error.", labels=("container", "reason")
        )
        for reason, count in sorted(self._calls.refusals().items()):
            refused.add_metric((self._container, reason), count)
        yield from (took, failed, refused)
        families: dict[str, CounterMetricFamily | GaugeMetricFamily] = {}
        for measure in self._measures():
            family = families.get(measure.name)
            if family is None:
                kind = CounterMetricFamily if measure.kind == "counter" else GaugeMetricFamily
                labels = ("container", *measure.labels)
                family = families[measure.name] = kind(f"{_PREFIX}{measure.name}", measure.doc, labels=labels)
            family.add_metric((self._container, *measure.labels.values()), measure.value)
        yield from families.values()


def open_metrics(
    settings: Settings, calls: CallCounters | None, measures: Callable[[], Iterable[Measure]], leaving: ExitStack
) -> int:
    """Serve ``/metrics`` until the stack closes, if configured. Returns the port; 0 if not configured.

    Raises:
        ConfigurationError: the extra is not installed, or the port is taken.
    """
    if calls is None:
        return 0
    try:
        from prometheus_client import CollectorRegistry, start_http_server  # noqa: PLC0415 - an extra
    except ImportError:
        raise ConfigurationError(where="TRADE_METRICS", problem=INSTALL) from None
    place = Endpoint.read(f"tcp/{settings.metrics}")
    registry = CollectorRegistry(auto_describe=False)
    registry.register(Metrics(settings.container, calls, measures))
    try:
        server, thread = start_http_server(place.port, place.host, registry)
    except OSError as taken:
        problem = f"{settings.metrics}: {taken.strerror}; each container of a host needs a port of its own"
        raise ConfigurationError(where="TRADE_METRICS", problem=problem) from None

    server.socket = cast("socket", BoundedListener(server.socket, _MOST_CONNECTIONS))
    server.socket.listen(_BACKLOG)
    server.RequestHandlerClass.timeout = _ASKED_WITHIN_S  # type: ignore[attr-defined] # as for every stream handler

    def close() -> None:
        server.shutdown()
        server.server_close()
        thread.join(2)

    leaving.callback(close)
    return server.server_port
