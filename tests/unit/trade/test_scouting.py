# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUnknownLambdaType=false
"""Scouting by the bytes of zenoh, which is the independent other side here; and a session that dials on request."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
import zenoh

from tests.support.waiting import wait_until
from trade.transport.endpoints import free_endpoint, loopback_interface
from trade.transport.interfaces import OwnAddress, is_near, own_addresses
from trade.transport.scouting import Beacon, hello, read_hello, scout
from trade.transport.zenoh import ZenohTransport, configuration

ID = "de88bef20f15d9afd64d6f625e211ef4"
CAPTURED = bytes.fromhex(
    "2209f1f41e215e626f4dd6afd9150ff2be88de01137463702f3132372e302e302e313a3435363731"
)  # of a zenoh 1.10 session with that id that listened there
HERE = OwnAddress("127.0.0.1", 8, 1)


@pytest.fixture
def leaving() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def beacon(leaving: ExitStack, *locators: str) -> Beacon:
    locators_now = list(locators)
    made = Beacon(ID, lambda *_: locators_now, here_only=True)
    return leaving.enter_context(closing(made))


def test_a_hello_has_the_bytes_that_zenoh_sends() -> None:
    assert hello(ID, ["tcp/127.0.0.1:45671"]) == CAPTURED
    assert read_hello(CAPTURED) == (ID, ["tcp/127.0.0.1:45671"])


@pytest.mark.parametrize("length", range(len(CAPTURED)))
def test_a_hello_that_is_cut_short_is_none(length: int) -> None:
    assert read_hello(CAPTURED[:length]) is None


def test_a_hello_has_any_number_of_locators() -> None:
    many = [f"tcp/10.98.{number}.1:7450" for number in range(200)]
    assert read_hello(hello(ID, many)) == (ID, many)


def test_zenoh_finds_a_beacon(leaving: ExitStack) -> None:
    beacon(leaving, "tcp/127.0.0.1:45671")
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/interface", json.dumps(loopback_interface()))
    asking = zenoh.scout(zenoh.handlers.FifoChannel(16), what="peer", config=config)
    leaving.callback(asking.stop)
    found: list[Any] = []

    def is_found() -> bool:
        found.extend(iter(asking.try_recv, None))
        return any(str(one.zid) == ID for one in found)

    wait_until(is_found, "zenoh's scout hears the beacon")


def test_a_scout_finds_a_beacon_and_zenoh(leaving: ExitStack) -> None:
    beacon(leaving, "tcp/127.0.0.1:45671")
    config = zenoh.Config()
    for key, value in (("scouting/multicast/interface", loopback_interface()), ("scouting/delay", 0)):
        config.insert_json5(key, json.dumps(value))
    session = leaving.enter_context(closing(zenoh.open(config)))

    def is_found() -> bool:
        found = dict(scout(0.3, lambda: False, here_only=True))
        return found.get(ID) == ["tcp/127.0.0.1:45671"] and str(session.zid()).lstrip("0") in found

    wait_until(is_found, "both are found")


def test_a_closed_beacon_is_silent(leaving: ExitStack) -> None:
    beacon(leaving, "tcp/127.0.0.1:45671").close()
    assert ID not in dict(scout(0.3, lambda: False, here_only=True))


def test_the_addresses_are_those_of_the_kernel() -> None:
    assert HERE in [own._replace(interface=1) for own in own_addresses()]
    assert is_near("127.9.9.9")
    assert not is_near("203.0.113.7")  # of no network: for documentation
    assert not HERE.dialled
    assert not OwnAddress("fe80::1", 64, 2).dialled
    assert OwnAddress("10.9.0.5", 24, 2).dialled


def opened(leaving: ExitStack, listen: str = "") -> ZenohTransport:
    made = ZenohTransport(
        configuration(
            namespace="scouting", listen=[listen or free_endpoint()], connect=[], credentials=("lab", "secret")
        )
    )
    return leaving.enter_context(closing(made))


@pytest.mark.parametrize("everywhere", [True, False])
def test_a_change_of_the_addresses_that_others_dial_is_logged(
    leaving: ExitStack, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, everywhere: bool
) -> None:
    known = [HERE, OwnAddress("10.9.0.5", 24, 2)]
    monkeypatch.setattr("trade.transport.zenoh_links.own_addresses", lambda: list(known))
    own = free_endpoint()
    links = opened(leaving, own.replace("127.0.0.1", "0.0.0.0") if everywhere else own).links
    links.watch_addresses()
    assert not links.moved()
    known[1] = OwnAddress("10.9.0.9", 24, 2)
    links.watch_addresses()
    assert links.moved() == everywhere
    assert ("the addresses of this host changed: new 10.9.0.9; gone 10.9.0.5." in caplog.text) == everywhere
    caplog.clear()
    links.watch_addresses()
    assert caplog.text == ""
    del known[1]
    links.watch_addresses()
    assert ("changed: gone 10.9.0.9." in caplog.text) == everywhere


def listener(transport: ZenohTransport, other: ZenohTransport) -> tuple[str, list[str]]:
    return other.links._own, list(map(str, other.links.listen))


def test_an_open_session_dials_on_request(leaving: ExitStack) -> None:
    one, other = opened(leaving), opened(leaving)
    assert one._prompt is not None
    assert one._prompt.dial(*listener(one, other))
    wait_until(lambda: one.links.linked(other.links._own), "they are linked")
    assert one.links.linked_at(str(other.links.listen[0]))  # it dialled


def test_S21_an_open_session_ignores_hellos_of_strangers(leaving: ExitStack) -> None:
    """A stranger who knows the port, and sends what we send, is not heard; afterwards we still are."""
    one, other = opened(leaving), opened(leaving)
    assert one._prompt is not None
    assert one._prompt._asked_by is not None
    _, port = one._prompt._asked_by
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for own in own_addresses():
            if ":" not in own.ip:
                stranger.sendto(hello(*listener(one, other)), (own.ip, port))
    threading.Event().wait(0.5)
    assert not one.links.linked(other.links._own)

    assert one._prompt.dial(*listener(one, other))
    wait_until(lambda: one.links.linked(other.links._own), "they are linked")


def test_a_session_with_another_id_is_not_linked(leaving: ExitStack) -> None:
    one, other = opened(leaving), opened(leaving)
    assert one._prompt is not None
    assert one._prompt.dial(ID, listener(one, other)[1])
    threading.Event().wait(0.5)
    assert not one.links.linked(other.links._own)


@pytest.mark.realtime
def test_a_session_without_peers_opens_at_once(leaving: ExitStack) -> None:
    took_s: list[float] = []
    for _ in range(5):
        began = time.monotonic()
        opened(leaving)
        took_s.append(time.monotonic() - began)
    assert min(took_s) < 0.4  # zenoh would wait 0.5 s for answers to its scouts
