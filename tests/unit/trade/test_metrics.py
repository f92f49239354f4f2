"""Metrics of a container, as Prometheus reads them: calls, durations, refusals, locks, what drivers add."""

import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Callable
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.support.strangers import is_closed
from tests.support.waiting import wait_until
from trade import Container, Measure, Resource, Settings, service, where
from trade._services.local_service import LocalService
from trade.errors import AccessDenied, ConfigurationError, InvalidArgument

Start = Callable[..., Container]
Samples = dict[tuple[str, ...], float]


class Arm:
    def __init__(self) -> None:
        self.resources = (Resource("rosie.arm"),)

    @service
    def reach(self, angle_rad: float) -> float:
        if angle_rad > 1:
            raise ValueError("too far")
        return angle_rad

    @service(effect="read")
    def angle(self) -> float:
        return 0.5

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def there(start_container: Start) -> Container:
    container = start_container("there", metrics="127.0.0.1:0")
    container.register(Arm(), "rosie.arm")
    return container


@pytest.mark.slow
def test_strangers_take_a_bounded_number_of_descriptors_and_threads(there: Container) -> None:
    before, strangers = threading.active_count(), list[socket.socket]()
    try:
        for _ in range(200):
            strangers.append(socket.create_connection(("127.0.0.1", there.metrics_port), timeout=20))
        wait_until(lambda: sum(is_closed(one) for one in strangers) >= 150, "most are closed at once")
        assert threading.active_count() - before <= 40
    finally:
        for one in strangers:
            one.close()
    wait_until(lambda: _answers(there), "it answers again")


def _answers(container: Container) -> bool:
    try:
        return bool(scraped(container))
    except OSError:
        return False


def scraped(container: Container) -> Samples:
    """Every sample, by its name and the values of its labels besides the container."""
    with urllib.request.urlopen(f"http://127.0.0.1:{container.metrics_port}/metrics", timeout=20) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    found: Samples = {}
    for family in families:
        for sample in family.samples:
            assert sample.labels["container"] == container.name
            labels = [name for name in sample.labels if name not in ("container", "le")]
            bound = [sample.labels["le"]] if "le" in sample.labels else []
            key = (sample.name, *(sample.labels[name] for name in labels), *bound)
            found[key] = sample.value
    return found


def call(here: Container, name: str, *args: Any) -> Any:
    return here.find(where(name=name, group="rosie.arm"), wait_s=20)(*args)


def test_calls_are_counted_by_service_with_how_long_they_took(here: Container, there: Container) -> None:
    for _ in range(3):
        call(here, "reach", 0.5)
    call(here, "angle")
    with pytest.raises(ValueError, match="far"):
        call(here, "reach", 2.0)
    found = scraped(there)
    assert found["trade_call_seconds_count", "rosie.arm.reach"] == 4
    assert found["trade_call_seconds_bucket", "rosie.arm.reach", "+Inf"] == 4
    assert found["trade_call_seconds_count", "rosie.arm.angle"] == 1
    assert found["trade_call_failures_total", "rosie.arm.reach"] == 1
    assert 0 < found["trade_call_seconds_sum", "rosie.arm.reach"] < 60
    assert ("trade_call_seconds_count", "rosie.arm.stop") not in found
    buckets = [value for key, value in found.items() if key[:2] == ("trade_call_seconds_bucket", "rosie.arm.reach")]
    assert buckets == sorted(buckets)
    assert found["trade_calls_total",] >= 5


def test_refusals_are_counted_by_reason(here: Container, there: Container, tmp_path: Any) -> None:
    with pytest.raises(InvalidArgument):
        call(here, "reach", "far")
    policy = tmp_path / "policy.toml"
    policy.write_text(f'[roles.none]\nregister = ["*"]\n[identities]\n"{there.address.identity}" = ["none"]\n')
    there.load_policy(policy)
    for _ in range(2):
        with pytest.raises(AccessDenied):
            call(here, "reach", 0.5)
    found = scraped(there)
    assert found["trade_refusals_total", "InvalidArgument"] == 1
    assert found["trade_refusals_total", "AccessDenied"] == 2


@pytest.mark.slow
def test_locks_and_e_stops_are_as_they_are_now(here: Container, there: Container) -> None:
    here.find(where(name="reach"), wait_s=20)
    with here.lock(where(group="rosie.arm")):
        assert scraped(there)["trade_locks",] == 1
    report = here.estop("")
    found = scraped(there)
    assert (found["trade_locks",], found["trade_estops_open",]) == (0, 1)
    here.estop_clear([report.id])
    assert scraped(there)["trade_estops_open",] == 0


def test_a_driver_adds_its_own_numbers(there: Container) -> None:
    cycles = iter(range(1, 10))
    there.measured_by(
        lambda: [
            Measure("bus_cycles", "Cycles.", next(cycles), {"bus": "neck"}, "counter"),
            Measure("device_temperature_celsius", "Warm.", 41.5, {"device": "pan"}),
        ]
    )
    assert scraped(there)["trade_bus_cycles_total", "neck"] == 1
    found = scraped(there)
    assert found["trade_bus_cycles_total", "neck"] == 2
    assert found["trade_device_temperature_celsius", "pan"] == 41.5


def test_the_record_says_how_far_it_is(here: Container, start_container: Start, tmp_path: Any) -> None:
    there = start_container("there", metrics="127.0.0.1:0", audit=tmp_path / "audit")
    there.register(Arm(), "rosie.arm")
    call(here, "reach", 0.5)
    found = scraped(there)
    assert found["trade_audit_lost_total",] == 0
    assert {("trade_audit_rows_total",), ("trade_audit_queue",)} <= found.keys()
    assert found["trade_call_seconds_count", "rosie.arm.reach"] == 1


@pytest.mark.slow
def test_the_port_is_free_again_when_the_containeris_closed(there: Container, start_container: Start) -> None:
    place = f"127.0.0.1:{there.metrics_port}"
    with pytest.raises(ConfigurationError, match="a port of its own"):
        start_container("other", metrics=place)
    there.close()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(f"http://{place}/metrics", timeout=5)
    other = start_container("other", metrics=place)
    assert scraped(other)["trade_containers",] >= 1


def test_when_off_nothing_is_counted_and_no_service_is_wrapped(here: Container, start_container: Start) -> None:
    there = start_container("there")
    there.register(Arm(), "rosie.arm")
    handle = here.find(where(name="reach"), wait_s=20)
    served: LocalService | None = there._parts.providers.service(handle.key)
    assert served is not None
    assert served.interceptors == ()
    assert there.metrics_port == 0


@pytest.mark.slow
def test_the_core_loads_the_library_only_if_it_is_wanted() -> None:
    program = "import sys, trade; sys.exit('prometheus_client' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=60, check=False).returncode == 0


def test_without_the_extra_the_remedy_is_named(start_container: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(ConfigurationError, match=r"trade-core\[metrics\]"):
        start_container("there", metrics="127.0.0.1:0")


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("9464", "is no HOST:PORT"),
        ("127.0.0.1:99999", "is no HOST:PORT"),
        ("0.0.0.0:9464", "put a proxy"),
        ("192.168.1.2:9464", "put a proxy"),
    ],
)
def test_places_that_would_expose_metrics_to_a_network_are_refused(place: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=f"TRADE_METRICS.*{says}"):
        Settings.read(environment={"TRADE_METRICS": place})
