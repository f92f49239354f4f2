"""Discovery, broadcast and links, switched while containers run."""

import socket
import threading
from pathlib import Path
from typing import Any

import pytest

import trade
from trade import Container, Handle, where
from trade.errors import CannotConnect, ConfigurationError, LinkStays, NoSuchService
from trade.transport.endpoints import Endpoint, free_endpoint

pytestmark = pytest.mark.realtime


@pytest.fixture
def apart(start_container: Any) -> tuple[Container, Container]:
    """Two containers of one system that know nothing of each other, and do not meet in the folder."""
    listens = [free_endpoint(), free_endpoint()]
    one, other = (start_container(name, listen=[at], connect=[at]) for name, at in zip("ab", listens, strict=True))
    return one, other


def clock_of(looking: Container, name: str, wait_s: float = 20) -> Handle:
    return looking.find(where(name="clock", container=name), wait_s=wait_s)


def test_a_container_that_broadcasts_is_found_by_one_that_discovers(apart: tuple[Container, Container]) -> None:
    one, other = apart
    one.system.set_broadcast(True)
    other.system.set_discovery(True)
    assert clock_of(other, "a")() > 0
    assert clock_of(one, "b")() > 0


def test_the_order_of_the_switches_does_not_matter(apart: tuple[Container, Container]) -> None:
    one, other = apart
    other.system.set_discovery(True)
    one.system.set_broadcast(True)
    assert clock_of(other, "a")() > 0


def test_the_link_outlives_both_switches(apart: tuple[Container, Container]) -> None:
    one, other = apart
    one.system.set_broadcast(True)
    other.system.set_discovery(True)
    clock = clock_of(other, "a")
    one.system.set_broadcast(False)
    other.system.set_discovery(False)
    assert all(clock() > 0 for _ in range(100))
    assert clock.alive


@pytest.mark.parametrize("switch", ["set_broadcast", "set_discovery"])
def test_one_switch_alone_links_no_container(apart: tuple[Container, Container], switch: str) -> None:
    for container in apart:
        getattr(container.system, switch)(True)
    with pytest.raises(NoSuchService):
        clock_of(apart[0], "b", wait_s=1.5)


@pytest.mark.parametrize("switch", ["set_broadcast", "set_discovery"])
def test_what_is_switched_off_again_is_off(apart: tuple[Container, Container], switch: str) -> None:
    one, other = apart
    for container, own in ((one, "set_broadcast"), (other, "set_discovery")):
        getattr(container.system, own)(True)
        if own == switch:
            getattr(container.system, own)(False)
    with pytest.raises(NoSuchService):
        clock_of(other, "a", wait_s=4.0)


def test_switching_twice_is_switching_once(apart: tuple[Container, Container]) -> None:
    for container in apart:
        for on in (True, True, False, False):
            container.system.set_broadcast(on)
            container.system.set_discovery(on)


def test_containers_of_other_systems_are_not_linked(start_container: Any) -> None:
    from trade.transport.zenoh import ZenohTransport

    listens = [free_endpoint(), free_endpoint()]
    one = start_container("a", listen=[listens[0]], connect=[listens[0]])
    other = start_container("b", listen=[listens[1]], connect=[listens[1]], system="another")
    one.system.set_broadcast(True)
    other.system.set_discovery(True)
    with pytest.raises(NoSuchService):
        clock_of(other, "a", wait_s=1.5)
    assert isinstance(other._parts.transport, ZenohTransport)
    assert isinstance(one._parts.transport, ZenohTransport)
    assert not other._parts.transport.links.linked(str(one._parts.transport._session.zid()))


def test_a_container_is_connected_while_it_runs(apart: tuple[Container, Container]) -> None:
    one, other = apart
    one.system.connect(other.settings.listen[0])
    assert clock_of(one, "b")() > 0
    assert clock_of(other, "a")() > 0


def test_an_endpoint_may_be_a_name(apart: tuple[Container, Container]) -> None:
    one, other = apart
    one.system.connect(f"tcp/localhost:{Endpoint.read(other.settings.listen[0]).port}")
    assert clock_of(one, "b")() > 0


def test_connecting_to_an_endpoint_without_a_listener_says_so(here: Container) -> None:
    empty = free_endpoint()
    with pytest.raises(CannotConnect, match=r"nothing accepts connections there \(tried .*\(refused\)\)$") as raised:
        here.system.connect(empty)
    assert raised.value.endpoint == empty
    assert isinstance(raised.value, ConnectionError)


def test_connecting_to_something_else_says_that_it_does_not_let_us_in(here: Container) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as other,
        pytest.raises(CannotConnect, match=r"no link was made .*accepts connections, but not this container"),
    ):
        here.system.connect(f"tcp/127.0.0.1:{other.getsockname()[1]}")


def test_connecting_to_a_name_that_means_nothing_says_so(system: str, start_container: Any) -> None:
    container = start_container("far", system=system, credentials=("me", "secret"), insecure_lan=True)
    with pytest.raises(CannotConnect, match="the name has no address now"):
        container.system.connect("tcp/no-such-host.invalid:7450")


def test_S21_a_network_is_not_reached_by_connecting_at_run_time(here: Container) -> None:
    with pytest.raises(ConfigurationError, match="beyond loopback requires certificates"):
        here.system.connect("tcp/192.168.1.5:7450")


def test_what_was_connected_is_linked_again_after_its_restart(start_container: Any, here: Container) -> None:
    endpoint = free_endpoint()
    settings = {"listen": [endpoint], "connect": [endpoint]}
    with start_container("there", **settings) as there:
        here.system.connect(endpoint)
        assert clock_of(here, "there").key.address == there.address
        first = clock_of(here, "there")
    assert here._parts.registry.wait_for(lambda: not first.alive, 20)
    again = start_container("there", **settings)
    assert clock_of(here, "there").key.address == again.address


def test_disconnecting_says_that_an_open_link_stays(apart: tuple[Container, Container]) -> None:
    one, other = apart
    endpoint = other.settings.listen[0]
    one.system.connect(endpoint)
    clock = clock_of(one, "b")
    with pytest.raises(LinkStays, match="stays while both containers run, but is not dialled again"):
        one.system.disconnect(endpoint)
    with pytest.raises(LinkStays, match="the link to b stays"):
        one.system.disconnect("b")
    assert clock() > 0


def test_what_was_disconnected_is_dialled_no_more(start_container: Any, here: Container, eventually: Any) -> None:
    endpoint = free_endpoint()
    settings = {"listen": [endpoint], "connect": [endpoint]}
    with start_container("there", **settings):
        here.system.connect(endpoint)
        first = clock_of(here, "there")
    assert here._parts.registry.wait_for(lambda: not first.alive, 20)

    def disconnected() -> bool:  # its sign of life falls a moment before its link does
        try:
            here.system.disconnect(endpoint)
        except LinkStays:
            return False
        return True

    assert eventually(disconnected)
    start_container("there", **settings)
    with pytest.raises(NoSuchService):
        clock_of(here, "there", wait_s=2.5)


def test_disconnecting_what_was_never_connected_does_nothing(here: Container) -> None:
    here.system.disconnect(free_endpoint())


def test_the_switches_are_services_of_every_container(apart: tuple[Container, Container], start_container: Any) -> None:
    one, other = apart
    visitor = start_container("visitor", connect=[one.settings.listen[0], other.settings.listen[0]])

    def switch(name: str, container: str) -> Handle:
        return visitor.find(where(name=name, group="trade", container=container), wait_s=20)

    switch("set_broadcast", "a")(True)
    switch("set_discovery", "b")(True)
    assert clock_of(other, "a")() > 0
    assert {info.name for info in switch("containers", "b")()} == {"a", "b", "visitor"}
    assert switch("set_discovery", "a").effect == "actuate"
    assert switch("containers", "a").effect == "read"
    with pytest.raises(CannotConnect):
        switch("connect", "a")(free_endpoint())


def test_the_default_container_has_the_same_switches(system: str) -> None:
    trade.system.set_broadcast(True)
    trade.system.set_discovery(True)
    assert [info.name for info in trade.system.containers()] == [trade.container().name]
    assert trade.container().reach.broadcasts
    assert trade.container().reach.discovers


def test_a_closed_container_has_no_switches(here: Container) -> None:
    here.close()
    with pytest.raises(Exception, match="closed"):
        here.system.set_discovery(True)


def test_toggling_discovery_and_broadcast_a_hundred_times_loses_no_call(
    start_program: Any, here: Container, tmp_path: Path
) -> None:
    """Both processes toggle; the calls go on all the while, and each returns what it should."""
    program = start_program(
        """
        class Echo:
            @service(effect="read")
            def echo(self, value: int) -> int:
                return value
        with Container(Settings.read(container="there")) as container:
            container.register(Echo(), "robot")
            say("ready")
            hear()
            for round in range(100):
                container.system.set_broadcast(round % 2 == 0)
                container.system.set_discovery(round % 2 == 1)
            say("toggled")
            hear()
        """
    )
    assert program.heard() == "ready"
    echo = here.find(where(name="echo", group="robot"), wait_s=20)
    toggler = threading.Thread(target=lambda: [toggle(here, number) for number in range(100)])
    toggler.start()
    program.tell()
    calls = 0
    while toggler.is_alive() or calls < 2000:
        assert echo(calls) == calls
        calls += 1
    assert program.heard() == "toggled"
    assert echo.alive
    program.tell()
    assert program.ends() == 0


def toggle(container: Container, number: int) -> None:
    container.system.set_discovery(number % 2 == 0)
    container.system.set_broadcast(number % 2 == 0)
