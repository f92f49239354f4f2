"""Notes of calls as OpenTelemetry's spans: ids, parents, what a collector gets; off unless a collector is named."""

import itertools
import secrets
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace import ReadableSpan
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.sdk.trace.sampling import Decision, TraceIdRatioBased
from opentelemetry.trace import SpanKind, StatusCode

from tests.support.waiting import wait_until
from trade import Container, Settings, current_call, service, where
from trade._telemetry.otlp import Export, trace_id
from trade.errors import ConfigurationError

Start = Callable[..., Container]


class Leg:
    @service
    def step(self, far_m: float) -> float:
        call = current_call()
        assert call is not None
        call.event("lifted")
        if far_m > 1:
            raise ValueError("too far")
        return far_m


class Mind:
    def __init__(self, container: Container) -> None:
        self.container = container

    @service
    def walk(self, far_m: float) -> float:
        return self.container.call(where(name="pace"), far_m)

    @service
    def pace(self, far_m: float) -> float:
        return self.container.call(where(name="step"), far_m)


SPANS = 5
"""Two calls between containers, noted at both ends, and one within a container."""


@pytest.fixture
def walk(start_container: Start) -> Callable[[float], list[ReadableSpan]]:
    """Calls over three containers, all of which note and export; gives the spans."""
    exporter = InMemorySpanExporter()
    user, mind, leg = (start_container(name) for name in ("user", "mind", "leg"))
    leg.register(Leg(), "rosie.leg")
    mind.register(Mind(mind), "rosie.mind")
    for container in (user, mind, leg):
        export = Export(SimpleSpanProcessor(exporter), {"service.name": container.name})
        container._parts.spans._on_span = export.tell

    def walked(far_m: float) -> list[ReadableSpan]:
        call = user.find(where(name="walk"), wait_s=30)
        for asking in (user, mind):  # tracing begins in the containers that the user knows
            asking.find(where(name="step"), wait_s=30)
        wait_until(lambda: len(user.services(where(name="set_tracing", group="trade"))) == 3)
        user.set_tracing(True)
        try:
            call(far_m)
        except ValueError:
            assert far_m > 1
        wait_until(lambda: len(exporter.get_finished_spans()) >= SPANS)  # an answer may come before its span is over
        return list(exporter.get_finished_spans())

    return walked


def _named(spans: list[ReadableSpan], name: str, kind: SpanKind) -> ReadableSpan:
    [found] = [span for span in spans if span.name == name and span.kind is kind]
    return found


def test_spans_have_the_first_call_as_their_trace_and_each_knows_its_parent(
    walk: Callable[[float], list[ReadableSpan]],
) -> None:
    spans = walk(0.5)
    chain = [
        _named(spans, "rosie.mind.walk", SpanKind.CLIENT),
        _named(spans, "rosie.mind.walk", SpanKind.SERVER),
        _named(spans, "rosie.mind.pace", SpanKind.INTERNAL),
        _named(spans, "rosie.leg.step", SpanKind.CLIENT),
        _named(spans, "rosie.leg.step", SpanKind.SERVER),
    ]
    assert len(spans) == len(chain)
    first = chain[1].context.span_id
    assert chain[1].attributes["trade.call_id"] == str(first)
    assert {span.context.trace_id for span in spans} == {trace_id(first)}
    assert chain[0].parent is None
    assert [span.parent.span_id for span in chain[1:]] == [span.context.span_id for span in chain[:-1]]
    assert len({span.context.span_id for span in spans}) == len(spans)
    assert [span.resource.attributes["service.name"] for span in chain] == ["user", "mind", "mind", "mind", "leg"]
    for outer, inner in itertools.pairwise(chain):
        assert outer.end_time - outer.start_time >= inner.end_time - inner.start_time


def test_errors_and_events_are_sent_without_arguments_and_messages(
    walk: Callable[[float], list[ReadableSpan]],
) -> None:
    step = _named(walk(1.75), "rosie.leg.step", SpanKind.SERVER)
    assert (step.status.status_code, step.status.description) == (StatusCode.ERROR, "ValueError")
    assert [event.name for event in step.events] == ["lifted"]
    assert step.start_time <= step.events[0].timestamp <= step.end_time
    assert "1.75" not in step.to_json()
    assert "too far" not in step.to_json()


class Collector:
    """Takes what is sent to it over HTTP."""

    def __init__(self) -> None:
        self.got: list[tuple[str, str, ExportTraceServiceRequest]] = []
        collector = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                sent = (self.path, self.headers["Content-Type"], ExportTraceServiceRequest.FromString(body))
                collector.got.append(sent)
                self.send_response(200)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: Any) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.block_on_close = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join(20)
        self._server.server_close()


@pytest.fixture
def collector() -> Iterator[Collector]:
    running = Collector()
    yield running
    running.close()


@contextmanager
def _three(url: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Container]:
    monkeypatch.setenv("TRADE_OTLP", url)
    with ExitStack() as stack:
        user, leg = (stack.enter_context(Container(Settings.read(container=name))) for name in ("user", "leg"))
        leg.register(Leg(), "rosie.leg")
        yield user


def test_a_collector_gets_what_is_noted_once_its_url_is_set(
    system: str, collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    with _three(collector.url, monkeypatch) as user:
        user.find(where(name="step"), wait_s=30)(0.5)
    assert {(path, kind) for path, kind, _ in collector.got} == {("/v1/traces", "application/x-protobuf")}
    resources = [one for _, _, request in collector.got for one in request.resource_spans]
    reported = {
        next(pair.value.string_value for pair in one.resource.attributes if pair.key == "service.name"): span
        for one in resources
        for scope in one.scope_spans
        for span in scope.spans
    }
    assert {name: span.name for name, span in reported.items()} == {"user": "rosie.leg.step", "leg": "rosie.leg.step"}
    assert reported["leg"].parent_span_id == reported["user"].span_id
    assert reported["leg"].trace_id == reported["user"].trace_id
    assert reported["leg"].trace_id[:8] != bytes(8)


@pytest.mark.parametrize("ratio", [0.1, 0.5])
def test_samplers_that_follow_the_trace_take_the_configured_share(ratio: float) -> None:
    """Ids of calls count up from a moment's chance, and are smaller than half of all that there are."""
    first, sampler, tried = secrets.randbits(38) << 24, TraceIdRatioBased(ratio), 4000
    taken = [sampler.should_sample(None, trace_id(first + number), "walk") for number in range(tried)]
    share = sum(one.decision is Decision.RECORD_AND_SAMPLE for one in taken) / tried
    assert share == pytest.approx(ratio, abs=0.05)


def test_calls_continue_and_containers_end_without_a_collector(
    system: str, collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade._telemetry.otlp._TIMEOUT_S", 0.2)
    collector.close()
    with _three(collector.url, monkeypatch) as user:
        assert user.find(where(name="step"), wait_s=30)(0.5) == 0.5
    assert not user.healthy()


def test_without_a_url_nothing_is_loaded_and_nothing_is_sent(start_container: Start) -> None:
    container = start_container("quiet")
    container.set_tracing(True, container="quiet")
    assert container._parts.spans._on_span is None


def test_what_is_not_installed_is_named_with_how_to(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace.export", None)
    with pytest.raises(ConfigurationError, match=r'pip install "trade-core\[otel\]"'):
        Container(Settings.read(container="leg", environment={"TRADE_OTLP": "http://127.0.0.1:4318"}))


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("127.0.0.1:4318", "is no URL of a collector"),
        ("ftp://127.0.0.1", "is no URL of a collector"),
        ("http://", "is no URL of a collector"),
        ("http://collector.example:4318", "write https://collector.example:4318"),
    ],
)
def test_an_invalid_collector_url_or_plain_http_to_another_host_is_refused(url: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        Settings.read(environment={"TRADE_OTLP": url})


@pytest.mark.parametrize("url", ["http://localhost:4318", "http://[::1]:4318/", "https://collector.example/otlp"])
def test_a_url_on_this_host_or_encrypted_is_taken_and_has_calls_noted(url: str) -> None:
    settings = Settings.read(environment={"TRADE_OTLP": url})
    assert (settings.otlp, settings.trace) == (url, True)
    assert not Settings.read(environment={}).trace


def test_the_core_alone_does_not_load_it() -> None:
    source = Path(__file__).parents[3] / "trade"
    paths = sorted(source.rglob("*.py"))
    assert len(paths) > 100
    for path in paths:
        top = [line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith(("import", "from"))]
        assert not [line for line in top if "opentelemetry" in line], path
