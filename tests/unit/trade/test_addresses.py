"""The addresses of a listener: which are tried, in which order, and what is said of each. The wire is a fake."""

import threading
import time
from collections.abc import Iterator, Sequence
from typing import cast

import pytest

from trade._discovery.dialer import Dialer
from trade._threads.scheduler import Scheduler
from trade.transport.addresses import Attempts
from trade.transport.endpoints import Endpoint
from trade.transport.zenoh_links import LinkAttempt, Links

pytestmark = pytest.mark.virtual_time

VPN = [f"tcp/10.99.{number}.1:7450" for number in range(6)]
GOOD = "tcp/10.9.0.5:7450"


class Wire:
    """Hosts that accept or refuse after their time; the others are silent."""

    def __init__(self, **hosts: tuple[float, str]) -> None:
        self.hosts = {name.replace("_", "."): said for name, said in hosts.items()}
        self.tried: list[list[str]] = []

    def knock(self, endpoints: Sequence[Endpoint], limit_s: float) -> Iterator[tuple[Endpoint, str]]:
        self.tried.append([endpoint.host for endpoint in endpoints])
        began = time.monotonic()
        answers = sorted((self.hosts[e.host][0], n) for n, e in enumerate(endpoints) if e.host in self.hosts)
        for after_s, number in answers:
            threading.Event().wait(max(0.0, began + after_s - time.monotonic()))
            yield endpoints[number], self.hosts[endpoints[number].host][1]
        threading.Event().wait(max(0.0, began + limit_s - time.monotonic()))
        yield from ((endpoint, "timed out") for endpoint in endpoints if endpoint.host not in self.hosts)


def as_written(endpoint: Endpoint) -> list[str]:
    return [str(endpoint)]


def test_the_address_that_answers_is_used_at_once_whatever_is_dead() -> None:
    wire = Wire(**{"10_9_0_5": (0.01, "")})
    began = time.monotonic()
    tried = Attempts(resolve=as_written, knocks=wire.knock)

    assert next(tried.accepting([*VPN, GOOD])) == GOOD
    assert time.monotonic() - began < 0.1


def test_fifty_addresses_take_no_longer_than_one() -> None:
    many = [f"tcp/10.98.{number}.1:7450" for number in range(50)]
    began = time.monotonic()
    tried = Attempts(resolve=as_written, knocks=Wire().knock)

    assert list(tried.accepting(many)) == []
    assert time.monotonic() - began < 2.0
    assert len(tried.listed()) == 50


def test_what_came_of_each_address_is_said_as_a_fact() -> None:
    wire = Wire(**{"10_9_0_5": (0.01, ""), "10_9_0_6": (0.02, "refused")})
    tried = Attempts(resolve=as_written, knocks=wire.knock)
    list(tried.accepting([VPN[0], "tcp/10.9.0.6:7450", GOOD]))
    threading.Event().wait(3.0)

    said = {attempt.address: attempt for attempt in tried.listed()}
    assert said[GOOD].problem == ""
    assert str(said["tcp/10.9.0.6:7450"]) == "10.9.0.6:7450 (refused)"
    assert str(said[VPN[0]]) == "10.99.0.1:7450 (timed out)"
    assert 2.9 < said[VPN[0]].ago_s < 3.5


def test_own_networks_come_first_and_what_failed_last_time_comes_last() -> None:
    wire = Wire(**{"10_9_0_5": (0.01, "")})
    tried = Attempts(lambda host: host.startswith("10.9."), as_written, wire.knock)
    dead = "tcp/10.9.0.7:7450"
    list(tried.accepting([VPN[0], dead, GOOD]))
    list(tried.accepting([VPN[0], dead, VPN[1], GOOD]))

    assert wire.tried[0] == ["10.9.0.7", "10.9.0.5", "10.99.0.1"]
    assert wire.tried[1] == ["10.9.0.5", "10.99.1.1", "10.9.0.7", "10.99.0.1"]


def test_a_name_is_resolved_at_each_try_to_all_its_addresses() -> None:
    known: list[str] = []
    wire = Wire(**{"10_9_0_5": (0.01, "")})
    tried = Attempts(resolve=lambda _: list(known), knocks=wire.knock)
    name = "tcp/rosie.local:7450"

    assert list(tried.accepting([name])) == []
    assert [str(attempt) for attempt in tried.listed()] == ["rosie.local:7450 (the name has no address now)"]
    assert wire.tried == []  # nothing was dialled

    known += [VPN[0], GOOD]
    assert next(tried.accepting([name])) == GOOD
    assert name not in [attempt.address for attempt in tried.listed()]


def test_with_tls_a_name_is_dialled_as_the_name_that_its_certificate_is_for() -> None:
    wire = Wire(**{"10_9_0_5": (0.01, "")})
    found = [address.replace("tcp", "tls") for address in (VPN[0], GOOD)]
    tried = Attempts(resolve=lambda _: found, knocks=wire.knock)

    assert list(tried.accepting(["tls/rosie.local:7450"])) == ["tls/rosie.local:7450"]


def test_what_only_the_transport_can_try_is_left_to_it() -> None:
    wire = Wire()
    asked = ["udp/10.9.0.5:7450", "tcp/10.9.0.5:7450#iface=eth0"]

    assert list(Attempts(resolve=as_written, knocks=wire.knock).accepting(asked)) == asked
    assert wire.tried == []


def test_an_attempt_is_of_the_last_try_only() -> None:
    tried = Attempts()
    tried.note(GOOD, "refused")
    tried.note(GOOD, "")

    assert [attempt[:2] for attempt in tried.listed()] == [(GOOD, "")]


class Cable:
    """In place of the links: what is dialled is linked, until the cable is pulled."""

    hub, certified, bridges = "", False, False
    connect: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.to: set[str] = set()

    def join(self, endpoint: str, *_: object) -> LinkAttempt:
        self.to.add(endpoint)
        return LinkAttempt(f"session-of-{endpoint}")

    def linked(self, session: str) -> bool:
        return any(f"session-of-{endpoint}" == session for endpoint in self.to)

    def linked_at(self, endpoint: str) -> bool:
        return endpoint in self.to


@pytest.fixture
def timers() -> Iterator[Scheduler]:
    made = Scheduler("trade-timers")
    yield made
    made.close()


def test_a_configured_name_is_dialled_at_the_addresses_that_it_has_now(timers: Scheduler) -> None:
    known: list[str] = []
    wire = Wire(**{"10_9_0_5": (0.01, ""), "10_9_0_6": (0.01, "")})
    cable, tried = Cable(), Attempts(resolve=lambda _: list(known), knocks=wire.knock)
    dialer = Dialer(cast("Links", cable), lambda _: None, timers, ["tcp/rosie.local:7450"], tried)
    try:
        threading.Event().wait(5.0)
        assert cable.to == set()
        known[:] = [VPN[0], GOOD]
        threading.Event().wait(5.0)
        assert cable.to == {GOOD}

        cable.to.clear()  # her address changes, and her name follows
        known[:] = ["tcp/10.9.0.6:7450"]
        threading.Event().wait(5.0)
        assert cable.to == {"tcp/10.9.0.6:7450"}
    finally:
        dialer.close()


def test_a_configured_address_is_left_to_the_transport(timers: Scheduler) -> None:
    wire, cable = Wire(), Cable()
    tried = Attempts(resolve=as_written, knocks=wire.knock)
    dialer = Dialer(cast("Links", cable), lambda _: None, timers, [VPN[0]], tried)
    try:
        threading.Event().wait(2.0)
        assert wire.tried == []
    finally:
        dialer.close()
