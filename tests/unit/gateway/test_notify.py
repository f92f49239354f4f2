"""Notifications to systemd: by a datagram to its socket, and by nothing else."""

import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from trade_gateway.terminal._sd_notify import Notifier


@pytest.fixture(params=["a path", "an abstract name"])
def listener(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, socket.socket]]:
    """Where systemd would listen, under both kinds of names."""
    name = str(tmp_path / "notify") if request.param == "a path" else f"@trade-test-{secrets.token_hex(4)}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as opened:
        opened.settimeout(10)
        opened.bind(name.replace("@", "\0", 1))
        yield name, opened


def heard(opened: socket.socket) -> dict[str, str]:
    lines = opened.recv(4096).decode().splitlines()
    return {name: value for name, _, value in (line.partition("=") for line in lines)}


def test_each_thing_is_sent_in_one_datagram(listener: tuple[str, socket.socket]) -> None:
    name, opened = listener
    with Notifier({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "30000000"}) as notifier:
        notifier.ready("two networks\nSTOPPING=1")
        notifier.alive()
        notifier.reloading()
        notifier.leaving()
    assert heard(opened) == {"READY": "1", "STATUS": "two networks STOPPING=1"}  # a line break says nothing more
    assert heard(opened) == {"WATCHDOG": "1"}
    reloading = heard(opened)
    assert reloading.pop("MONOTONIC_USEC").isdigit()
    assert reloading == {"RELOADING": "1"}
    assert heard(opened)["STOPPING"] == "1"


@pytest.mark.parametrize(
    "asked",
    [{}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "soon"}, {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}],
    ids=str,
)
def test_a_watchdog_that_watches_another_source_or_none_is_not_fed(
    listener: tuple[str, socket.socket], asked: dict[str, str]
) -> None:
    name, opened = listener
    with Notifier({"NOTIFY_SOCKET": name, **asked}) as notifier:
        notifier.alive()
        notifier.ready("up")
    assert heard(opened)["READY"] == "1"  # the first that came


def test_a_watchdog_of_this_very_process_is_fed(listener: tuple[str, socket.socket]) -> None:
    name, opened = listener
    mine = {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": str(os.getpid())}
    with Notifier(mine) as notifier:
        notifier.alive()
    assert heard(opened) == {"WATCHDOG": "1"}
    assert mine == {}  # no child finds it, and speaks for this process


@pytest.mark.parametrize("name", ["", "vsock:2:9999", "/nowhere/notify"])
def test_without_listeners_nothing_is_sent_and_nothing_fails(name: str) -> None:
    with Notifier({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000000"}) as notifier:
        notifier.ready("up")
        notifier.alive()
        notifier.leaving()


def test_a_listener_that_goes_away_ends_nothing(listener: tuple[str, socket.socket]) -> None:
    name, opened = listener
    with Notifier({"NOTIFY_SOCKET": name}) as notifier:
        opened.close()
        notifier.ready("up")
        notifier.leaving()
