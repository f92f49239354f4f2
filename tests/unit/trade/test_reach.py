"""S21: nothing reaches beyond this host by accident."""

import ipaddress
import os
from typing import Any

import psutil
import pytest

from trade import Container, Settings, service, where
from trade.errors import ConfigurationError

pytestmark = pytest.mark.virtual_time


def read(**settings: Any) -> Settings:
    return Settings.read(environment={}, **settings)


@pytest.mark.real_clock
def test_S21_with_default_settings_a_container_listens_on_loopback_only(here: Container) -> None:
    listening = {
        connection.laddr.ip
        for connection in psutil.Process().net_connections("inet")
        if connection.status == psutil.CONN_LISTEN or not connection.raddr
    }
    assert listening
    assert all(ipaddress.ip_address(address).is_loopback for address in listening)


def test_S21_the_default_system_is_the_users_on_this_host() -> None:
    user, dash, host = read().system.partition("-")
    assert user and dash and host
    assert not read().explicit_system


BEYOND = ["tcp/0.0.0.0:7450", "tcp/[::]:7450", "tcp/192.168.1.5:0", "udp/10.0.0.1:1"]


@pytest.mark.parametrize("end", ["listen", "connect"])
@pytest.mark.parametrize("endpoint", BEYOND)
def test_S21_beyond_loopback_is_refused_without_certificates(end: str, endpoint: str) -> None:
    with pytest.raises(ConfigurationError, match=r"beyond loopback requires certificates: set TRADE_TLS .*and tls/"):
        read(system="lab", credentials=("me", "secret"), **{end: [endpoint]})


@pytest.mark.parametrize("missing", [{"system": "lab"}, {"credentials": ("me", "secret")}, {}], ids=str)
def test_S21_reaching_a_laboratory_network_needs_a_system_and_credentials(missing: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match="TRADE_INSECURE_LAN needs an explicit system id and credentials"):
        read(connect=["tcp/192.168.1.5:7450"], insecure_lan=True, **missing)


def test_S21_a_laboratory_network_may_be_reached_on_purpose() -> None:
    lab = {"system": "lab", "credentials": ("me", "secret"), "insecure_lan": True}
    assert read(connect=["tcp/robot.example:7447"], **lab).connect == ("tcp/robot.example:7447",)


def test_an_empty_system_in_the_environment_is_no_explicit_one() -> None:
    assert not Settings.read(environment={"TRADE_SYSTEM": ""}).explicit_system


def test_S21_a_bridge_listens_beyond_loopback_no_more_than_others() -> None:
    lan = ["tcp/192.168.1.5:7450", "tcp/10.0.0.5:7450"]
    with pytest.raises(ConfigurationError, match="beyond loopback requires certificates"):
        read(system="lab", credentials=("me", "secret"), listen=lan, bridge=["eth0", "eth1"])


@pytest.mark.parametrize("bridge", [["eth0"], ["eth0", "eth0"]])
def test_a_bridge_to_nowhere_is_refused(bridge: list[str]) -> None:
    with pytest.raises(ConfigurationError, match="bridge eth0: joins networks, and this is only one; name a second"):
        read(bridge=bridge)
    assert read(bridge=bridge, connect=["tcp/127.0.0.1:7450"]).bridge == tuple(bridge)


@pytest.mark.real_clock
def test_a_bridge_of_an_interface_that_is_not_there_is_refused_and_leaves_nothing(system: str) -> None:
    with pytest.raises(ConfigurationError, match="bridge nosuch0: this host has no such interface, or not yet; it has"):
        Container(Settings.read(bridge=["nosuch0", "nosuch1"]))


LOOPBACK = ["tcp/127.0.0.1:0", "tcp/127.8.9.1:7450", "tcp/[::1]:7450", "tcp/localhost:7450", "tcp/127.0.0.1:1#a=b"]


@pytest.mark.parametrize("endpoint", LOOPBACK)
def test_loopback_endpoints_are_allowed(endpoint: str) -> None:
    assert read(listen=[endpoint], connect=[endpoint]).listen == (endpoint,)


BROKEN = ["", "tcp", "127.0.0.1:7450", "tcp/127.0.0.1", "tcp/:7450", "tcp/127.0.0.1:", "tcp/127.0.0.1:x", "tcp//:1x"]


@pytest.mark.parametrize("endpoint", [*BROKEN, "tcp/127.0.0.1:\uff17\uff14"])
@pytest.mark.parametrize("what", ["listen", "connect"])
def test_a_malformed_endpoint_is_refused_with_an_example(what: str, endpoint: str) -> None:
    with pytest.raises(ConfigurationError, match=r"must look like tcp/127.0.0.1:7450"):
        read(**{what: [endpoint]})


@pytest.mark.parametrize(
    ("endpoint", "problem"),
    [
        ("tcp/127.0.0.1:65536", "there is no port 65536; ports go up to 65535"),
        ("tpc/127.0.0.1:7450", "there is no protocol 'tpc'; there is tcp"),
    ],
)
@pytest.mark.parametrize("what", ["listen", "connect"])
def test_an_impossible_endpoint_is_refused_with_a_message_of_trade(what: str, endpoint: str, problem: str) -> None:
    with pytest.raises(ConfigurationError, match=problem):
        read(**{what: [endpoint]})


@pytest.mark.parametrize(
    ("name", "hint"),
    [("TRADE_SYTEM", "did you mean TRADE_SYSTEM?"), ("TRADE_COLOUR", "there is TRADE_SYSTEM, TRADE_IDENTITY")],
)
def test_an_unread_variable_causes_a_warning(name: str, hint: str, caplog: pytest.LogCaptureFixture) -> None:
    Settings.read(environment={name: "x", "TRADE_SYSTEM": "lab", "TRADING": "x"})
    [said] = caplog.messages
    assert name in said
    assert hint in said


@pytest.mark.parametrize("name", ["a/b", "*", "a b", "@me", "x" * 81, ".", "..", "ä"])
@pytest.mark.parametrize("what", ["system", "identity", "container"])
def test_a_name_that_is_not_allowed_in_a_key_is_refused(what: str, name: str) -> None:
    with pytest.raises(ConfigurationError, match=f"is no name for a {what}; use letters, digits"):
        read(**{what: name})


@pytest.mark.parametrize("text", ["me", "me:", ":secret"])
def test_malformed_credentials_are_refused_without_repeating_them(text: str) -> None:
    with pytest.raises(ConfigurationError, match="TRADE_CREDENTIALS: must be user:password"):
        Settings.read(environment={"TRADE_CREDENTIALS": text})


def test_settings_come_from_arguments_then_the_environment_then_defaults() -> None:
    environment = {
        "TRADE_SYSTEM": "lab",
        "TRADE_IDENTITY": "arm",
        "TRADE_CONTAINER": "driver",
        "TRADE_LISTEN": "tcp/127.0.0.1:7450, tcp/127.0.0.1:7451",
        "TRADE_CONNECT": "",
        "TRADE_CREDENTIALS": "me:sec:ret",
        "TRADE_BRIDGE": "eth0, eth1",
    }
    settings = Settings.read(environment=environment, container="mine")
    assert (settings.system, settings.identity, settings.container) == ("lab", "arm", "mine")
    assert settings.listen == ("tcp/127.0.0.1:7450", "tcp/127.0.0.1:7451")
    assert (settings.connect, settings.credentials, settings.explicit_system) == ((), ("me", "sec:ret"), True)
    assert settings.bridge == ("eth0", "eth1")
    assert Settings.read(environment=environment, bridge=[]).bridge == read().bridge == ()
    assert str(os.getpid()) in read().container


def test_a_container_may_be_reached_at_a_chosen_endpoint(system: str) -> None:
    from trade.transport.endpoints import free_endpoint

    class Echo:
        @service(effect="read")
        def echo(self, value: int) -> int:
            return value

    endpoint = free_endpoint()
    with (
        Container(Settings.read(container="server", listen=[endpoint])) as server,
        Container(Settings.read(container="client", connect=[endpoint])) as client,
    ):
        server.register(Echo(), "robot")
        assert client.find(where(name="echo"), wait_s=20)(3) == 3


@pytest.mark.real_clock
def test_an_endpoint_that_is_taken_is_refused_and_leaves_nothing(here: Container, system: str) -> None:
    taken = next(
        connection.laddr.port
        for connection in psutil.Process().net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    )
    with pytest.raises(
        ConfigurationError, match=rf"listen tcp/127.0.0.1:{taken}: cannot listen there: .*; is the addr"
    ):
        Container(Settings.read(container="second", listen=[f"tcp/127.0.0.1:{taken}"]))


@pytest.mark.real_clock
@pytest.mark.parametrize("listen", [[], ["tcp/127.0.0.1:0"]])
def test_when_a_free_port_is_taken_in_between_another_one_is_tried(
    here: Container, system: str, monkeypatch: pytest.MonkeyPatch, listen: list[str]
) -> None:
    from trade._discovery import join
    from trade.transport.endpoints import Endpoint, free_endpoint

    taken = next(
        connection.laddr.port
        for connection in psutil.Process().net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    )
    endpoints = map(Endpoint.read, [f"tcp/127.0.0.1:{taken}", f"tcp/127.0.0.1:{taken}", free_endpoint()])
    monkeypatch.setattr(join, "with_free_port", lambda _: next(endpoints))
    with Container(Settings.read(container="second", listen=listen)) as second:
        assert {info.name for info in second.containers()} == {"here", "second"}


def test_a_container_reached_at_its_endpoint_is_reached_again_after_its_restart(system: str) -> None:
    from trade.transport.endpoints import free_endpoint

    endpoint = free_endpoint()
    with Container(Settings.read(container="client", connect=[endpoint])) as client:
        for _ in range(2):
            with Container(Settings.read(container="server", listen=[endpoint])) as server:
                clock = client.find(where(name="clock", container="server", local=False), wait_s=30)
                assert clock.key.address == server.address
                assert clock() > 0
            assert client._parts.registry.wait_for(lambda clock=clock: not clock.alive, 20)
