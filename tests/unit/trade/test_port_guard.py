"""While too many strangers are at the port of a transport, the kernel lets no other connection in."""

import logging
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

from tests.support.certificates import Papers
from tests.support.waiting import wait_until
from trade import Container, Settings
from trade.transport.endpoints import Endpoint, free_endpoint
from trade.transport.port_guard import MOST_STRANGERS, MOST_WITH_TLS, PortGuard

PER_S, FLOOD_S = 50, 8
SOON_S = 10.0
pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(sys.platform != "linux", reason="there are such filters on Linux only"),
]


def none() -> set[str]:
    """No link."""
    return set()


@pytest.fixture
def door() -> Iterator[socket.socket]:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen(1024)
        yield listening


@pytest.fixture
def dial() -> Iterator[Callable[[int], bool]]:
    """Connect to a port of this host, and stay; whether that succeeds at once."""
    there: list[socket.socket] = []

    def connect(port: int) -> bool:
        sock = socket.socket()
        there.append(sock)
        sock.settimeout(0.2)
        try:
            sock.connect(("127.0.0.1", port))
        except TimeoutError:
            return False
        return True

    yield connect
    for sock in there:
        sock.close()


def test_connections_beyond_the_limit_are_dropped_until_others_have_gone(
    door: socket.socket, dial: Callable[[int], bool], caplog: pytest.LogCaptureFixture
) -> None:
    port, links = door.getsockname()[1], [0]
    guard = PortGuard([port], lambda: links[0], none)
    try:
        # Both ends of a connection on this host are connections, and one of them is at the port.
        assert all(dial(port) for _ in range(MOST_STRANGERS + 2))
        wait_until(lambda: not dial(port))
        assert f"at port {port} are not links" in caplog.text
        links[0] = 10 * MOST_STRANGERS
        wait_until(lambda: dial(port))
    finally:
        guard.close()


def test_established_links_do_not_count_as_strangers(door: socket.socket, dial: Callable[[int], bool]) -> None:
    port, looked = door.getsockname()[1], [0]

    def links() -> int:
        looked[0] += 1
        return MOST_STRANGERS + 2

    guard = PortGuard([port], links, none)
    try:
        assert all(dial(port) for _ in range(MOST_STRANGERS + 2))
        wait_until(lambda: looked[0] > 0)
        assert dial(port)
    finally:
        guard.close()


def test_the_connections_are_inspected_again_only_while_there_are_many_strangers(
    door: socket.socket, dial: Callable[[int], bool]
) -> None:
    looks = {"few": 0, "many": 0}

    def count(kind: str) -> int:
        looks[kind] += 1
        return 0

    with socket.create_server(("127.0.0.1", 0), backlog=MOST_STRANGERS) as other:
        ports = {"few": door.getsockname()[1], "many": other.getsockname()[1]}
        assert all(dial(ports["few"]) for _ in range(MOST_STRANGERS // 2))
        assert all(dial(ports["many"]) for _ in range(MOST_STRANGERS // 2 + 1))
        guards = [PortGuard([port], partial(count, kind), none) for kind, port in ports.items()]
        try:
            wait_until(lambda: looks["many"] > 6)
            assert looks["few"] <= 2  # at the beginning, and for those who arrived before
            looks["few"] = 0
            assert dial(ports["few"])
            wait_until(lambda: looks["few"] > 0)
        finally:
            for guard in guards:
                guard.close()


def test_a_guard_that_is_closed_lets_all_in(door: socket.socket, dial: Callable[[int], bool]) -> None:
    port = door.getsockname()[1]
    guard = PortGuard([port], lambda: 0, none)
    assert all(dial(port) for _ in range(MOST_STRANGERS + 2))
    wait_until(lambda: not dial(port))
    guard.close()
    assert dial(port)


@pytest.mark.parametrize("address", ["127.0.0.1", "::1", "::ffff:127.0.0.1"])
def test_a_connection_that_stays_without_being_a_link_is_ended(address: str, caplog: pytest.LogCaptureFixture) -> None:
    """As one of which the transport has lost count. The far end of a link, and this process's own end, stay open."""
    mapped = address.startswith("::f")
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.create_server(("::" if mapped else address, 0), family=family, dualstack_ipv6=mapped) as server:
        port = server.getsockname()[1]
        with ExitStack() as stack:

            def connect() -> tuple[socket.socket, socket.socket]:
                """The far end, and the end here."""
                there = stack.enter_context(socket.create_connection((address.removeprefix("::ffff:"), port)))
                return there, stack.enter_context(server.accept()[0])

            (link, linked_here), (stray, stray_here) = connect(), connect()
            host, far_port = link.getsockname()[:2]
            guard = PortGuard([port], lambda: 1, lambda: {f"tcp/{f'[{host}]' if ':' in host else host}:{far_port}"})
            stack.callback(guard.close)
            stray.settimeout(30)
            assert stray.recv(1) == b""
            assert stray_here.recv(1) == b""
            wait_until(lambda: f"1 connections at port {port} were no links" in caplog.text)
            linked_here.sendall(b"x")
            assert link.recv(1) == b"x"


def test_connections_are_not_ended_while_the_links_are_unknown(door: socket.socket) -> None:
    looks = [0]

    def unknown() -> None:
        looks[0] += 1

    port = door.getsockname()[1]
    with socket.create_connection(("127.0.0.1", port)) as there, door.accept()[0] as here:
        guard = PortGuard([port], lambda: 1, unknown)
        try:
            wait_until(lambda: looks[0] >= 3, "three looks, each six seconds after the one before")
            here.sendall(b"x")
            assert there.recv(1) == b"x"
        finally:
            guard.close()


def test_the_port_of_a_container_is_guarded_and_newcomers_are_linked_again(
    system: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    papers = Papers(tmp_path / "pki")
    endpoint = free_endpoint().replace("tcp/", "tls/")
    port = Endpoint.read(endpoint).port

    def settings(name: str, **how: list[str]) -> Settings:
        return Settings.read(system=system, container=name, tls=papers.of(name), environment={}, **how)  # type: ignore[arg-type]

    with Container(settings("driver", listen=[endpoint])) as driver:
        crowd = [socket.socket() for _ in range(MOST_STRANGERS + 10)]
        for one in crowd:
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", port))  # the guard may drop it: then it is not connected before all have gone
        wait_until(lambda: "are not links" in caplog.text)
        for one in crowd:
            one.close()
        with caplog.at_level(logging.INFO), Container(settings("mind", connect=[endpoint])) as mind:
            wait_until(lambda: len(mind.addresses()) == 2)
            wait_until(lambda: len(driver.addresses()) == 2)


def test_another_network_of_the_port_stays_open(door: socket.socket, dial: Callable[[int], bool]) -> None:
    port = door.getsockname()[1]
    with socket.create_server(("127.0.0.2", port), backlog=64):
        guard = PortGuard([port], lambda: 0, none)
        try:
            assert all(dial(port) for _ in range(MOST_STRANGERS + 2))
            wait_until(lambda: not dial(port), "the crowded one is shut")
            with socket.create_connection(("127.0.0.2", port), timeout=5):
                pass
        finally:
            guard.close()


def test_connections_from_before_the_guard_count(
    door: socket.socket, dial: Callable[[int], bool], caplog: pytest.LogCaptureFixture
) -> None:
    port = door.getsockname()[1]
    assert all(dial(port) for _ in range(MOST_STRANGERS + 2))
    accepted = [door.accept()[0] for _ in range(MOST_STRANGERS + 2)]  # so that none of them is an event
    guard = PortGuard([port], lambda: 0, none)
    try:
        wait_until(lambda: f"at port {port} are not links" in caplog.text, "it is logged, with no further one")
        assert not dial(port)
    finally:
        guard.close()
        for one in accepted:
            one.close()


def test_connections_that_their_clients_have_ended_count_and_the_log_names_rate_and_source(
    door: socket.socket, dial: Callable[[int], bool], caplog: pytest.LogCaptureFixture
) -> None:
    port = door.getsockname()[1]
    guard = PortGuard([port], lambda: 0, none, MOST_WITH_TLS)
    try:
        there: list[socket.socket] = []
        for _ in range(MOST_WITH_TLS + 2):
            with socket.create_connection(("127.0.0.1", port), timeout=5):
                there.append(door.accept()[0])  # and the other end hangs up
        wait_until(lambda: "are not links" in caplog.text)
        assert "a second" in caplog.text
        assert "of them from 127.0.0.1" in caplog.text
        wait_until(lambda: not dial(port))
        for one in there:
            one.close()
        wait_until(lambda: dial(port))
    finally:
        guard.close()


def test_links_come_back_soon_after_a_flood_of_connects_to_a_port_with_tls(system: str, tmp_path: Path) -> None:
    papers = Papers(tmp_path / "pki")
    endpoint = free_endpoint().replace("tcp/", "tls/")
    port = Endpoint.read(endpoint).port

    def settings(name: str, **how: list[str]) -> Settings:
        return Settings.read(system=system, container=name, tls=papers.of(name), environment={}, **how)  # type: ignore[arg-type]

    with Container(settings("driver", listen=[endpoint])):
        for _ in range(PER_S * FLOOD_S):
            with socket.socket() as one:
                one.setblocking(False)
                one.connect_ex(("127.0.0.1", port))
                threading.Event().wait(1 / PER_S)
        ended = time.monotonic()
        with Container(settings("mind", connect=[endpoint])) as mind:
            wait_until(lambda: len(mind.addresses()) == 2)
        assert time.monotonic() - ended < SOON_S  # without the guard, the transport needs 0.1 s for each of them
