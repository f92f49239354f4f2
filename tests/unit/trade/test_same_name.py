"""Several addresses of one container, and several containers of one name."""

import socket
import threading
from typing import Any

import pytest

from trade import Container, Handle, service, where
from trade.errors import ConfigurationError
from trade.protocol.messages import decode_reply
from trade.transport import endpoints
from trade.transport.endpoints import free_endpoint


class Echo:
    @service(effect="read")
    def echo(self, value: str) -> str:
        return value


@pytest.fixture
def twins(start_container: Any) -> tuple[Container, Container]:
    return start_container("twin"), start_container("twin")


def clocks(looking: Container, name: str, count: int) -> list[Handle]:
    wanted = where(name="clock", container=name)
    assert looking._parts.registry.wait_for(lambda: len(looking.services(wanted)) == count, 20)
    return looking.services(wanted)


def test_the_registry_shows_both_containers_of_one_name(twins: tuple[Container, Container], here: Container) -> None:
    handles = clocks(here, "twin", 2)
    assert {handle.key.address for handle in handles} == {twin.address for twin in twins}
    assert all(handle() > 0 for handle in handles)
    infos = [info for info in here.containers() if info.name == "twin"]
    assert {info.epoch for info in infos} == {twin.address.epoch for twin in twins}
    assert len({info.identity for info in infos}) == 1


def test_containers_of_one_name_call_each_other(twins: tuple[Container, Container]) -> None:
    one, other = twins
    other.register(Echo(), "robot")
    assert one.find(where(name="echo", local=False), wait_s=20)("hello") == "hello"


def test_when_one_of_two_of_a_name_ends_the_other_stays(twins: tuple[Container, Container], here: Container) -> None:
    one, other = twins
    handles = {handle.key.address: handle for handle in clocks(here, "twin", 2)}
    one.close()
    assert here._parts.registry.wait_for(lambda: not handles[one.address].alive, 20)
    assert handles[other.address]() > 0


@pytest.mark.usefixtures("no_local_path")
def test_answers_to_two_callers_of_one_name_do_not_cross(
    twins: tuple[Container, Container], here: Container, open_raw: Any
) -> None:
    """Both call at once, many times: each gets its own answers, on keys that the other one does not hear."""
    here.register(Echo(), "robot")
    handles = [twin.find(where(name="echo"), wait_s=20) for twin in twins]
    raw = open_raw(here)
    answers = raw.subscribe("reply/**")
    wrong: list[str] = []

    def ask(number: int) -> None:
        for turn in range(200):
            sent = f"{number}.{turn}"
            if (got := handles[number](sent)) != sent:
                wrong.append(f"{sent}: {got}")

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    keys: dict[str, set[int]] = {}
    for _ in range(400):
        message = answers.receive()
        keys.setdefault(message.key, set()).add(decode_reply(message.payload or b"").id >> 24)
    for thread in threads:
        thread.join()
    assert wrong == []
    assert all(len(callers) == 1 for callers in keys.values())  # ids of one caller begin alike
    assert {key.split("/")[-1].split("-")[0] for key in keys} == {twin.address.epoch for twin in twins}


def test_a_container_is_reached_at_each_of_its_addresses(start_container: Any) -> None:
    listens = [free_endpoint(), free_endpoint(), "tcp/127.0.0.1:0"]
    server = start_container("server", listen=listens)
    server.register(Echo(), "robot")
    for number, endpoint in enumerate(listens[:2]):
        client = start_container(f"client-{number}", connect=[endpoint])
        assert client.find(where(name="echo"), wait_s=20)("hello") == "hello"


def test_an_address_of_another_host_is_reported_by_name(start_container: Any, system: str) -> None:
    lan = {"insecure_lan": True, "system": system, "credentials": ("me", "secret")}
    with pytest.raises(ConfigurationError, match=r"listen tcp/127.0.0.1:\d+, tcp/192\.0\.2\.77:7450: cannot listen"):
        start_container("far", listen=["tcp/127.0.0.1:0", "tcp/192.0.2.77:7450"], **lan)


def test_a_name_is_resolved_when_it_is_dialled(start_container: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = free_endpoint()
    server = start_container("server", listen=[endpoint], connect=[endpoint])
    client = start_container("client", connect=["tcp/127.0.0.1:1"])
    real, asked = socket.getaddrinfo, []

    def lookup(host: str, port: int, **more: Any) -> Any:
        asked.append(host)
        return real("127.0.0.1" if host == "localhost" else host, port, **more)

    monkeypatch.setattr(endpoints.socket, "getaddrinfo", lookup)
    port = endpoint.rsplit(":", 1)[1]
    client.system.connect(f"tcp/localhost:{port}")
    assert asked[0] == "localhost"
    assert client.find(where(name="clock", container="server"), wait_s=20).key.address == server.address
