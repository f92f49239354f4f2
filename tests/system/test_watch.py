"""``trade watch`` reports events, and ``trade top`` the load, from outside of the containers concerned."""

import signal
import subprocess
from collections.abc import Callable
from typing import Any

import pytest

from tests.system.conftest import Program
from trade import Container, service, where

pytestmark = pytest.mark.slow

StartContainer = Callable[..., Container]
Run = Callable[..., Program]
Command = Callable[..., subprocess.CompletedProcess[str]]


class Lamp:
    @service(uses="lamp")
    def shine(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...

    @service(effect="read")
    def shines(self) -> bool:
        return False


@pytest.fixture
def hall(start_container: StartContainer) -> Container:
    hall = start_container("hall")
    hall.register(Lamp(), "hall.lamp")
    return hall


def test_watch_prints_each_kind_of_event_with_its_own_name(
    hall: Container, run: Run, start_container: StartContainer
) -> None:
    me = start_container("me")
    with me.lock(where(group="hall.lamp"), purpose="reading", wait_s=30):
        watching = run("-m", "trade_gateway", "watch", "--json")
        locked = watching.wait_for(lambda said: said["what"] == "locked")
        assert (locked["container"], "(reading)" in locked["text"]) == ("hall", True)
    assert watching.wait_for(lambda said: said["what"] == "released")["about"] == locked["about"]

    def next_of(what: str, about: str) -> dict[str, Any]:
        return watching.wait_for(lambda said: (said["what"], said["about"]) == (what, about))

    lamp = Lamp()
    hall.register(lamp, "hall.other")
    next_of("came", "hall.other.shine")
    hall.set_health(lamp, "its wire is loose")
    assert next_of("is not well", "hall.other.shine")["text"] == "its wire is loose"
    hall.set_health(lamp, "healthy")
    next_of("is well", "hall.other.shine")
    hall.deregister(lamp)
    next_of("went", "hall.other.shine")
    report = hall.estop("smoke")
    assert next_of("e-stop", report.id)["text"].endswith(": smoke")
    hall.estop_clear([report.id])
    next_of("cleared", report.id)
    watching.signal(signal.SIGINT)
    assert watching.wait() == 130


def test_watch_prints_only_the_requested_group_and_sums_up_a_burst_in_one_line(
    hall: Container, run: Run, start_container: StartContainer
) -> None:
    watching = run("-m", "trade_gateway", "watch", "--group", "hall.row")
    assert watching.line().startswith("watching 0 services in system ")
    hall.register(Lamp(), "hall.column")
    for number in range(4):
        hall.register(Lamp(), f"hall.row.{number}")
    reported = watching.line()
    assert " hall " in reported
    assert " came " in reported
    assert "hall.column" not in reported


def test_load_silent_devices_and_problems_are_shown(
    hall: Container, run: Run, start_container: StartContainer, trade_command: Command
) -> None:
    frozen = run("-m", "trade_gateway", "container", "--name", "frozen", "--json")
    frozen.json()
    lamp = Lamp()
    hall.register(lamp, "hall.other")
    hall.set_health(lamp, "its wire is loose")
    me = start_container("me")
    with me.lock(where(group="hall.lamp"), purpose="reading", wait_s=30):
        looking = run("-m", "trade_gateway", "top", "--every", "1", "--json")
        assert looking.json()["silent"] == []
        frozen.signal(signal.SIGSTOP)
        try:
            reported = looking.wait_for(lambda shown: shown["silent"] == ["frozen"])
        finally:
            frozen.signal(signal.SIGCONT)
        text = trade_command("top", "--count", "1", "--every", "1").stdout
    assert {"hall", "me"} <= {info["container"] for info in reported["containers"]}
    assert reported["silent"] == ["frozen"]
    assert reported["unwell"] == [{"group": "hall.other", "container": "hall", "health": "its wire is loose"}]
    [locked] = reported["locks"]
    assert (locked["purpose"], locked["waiting"]) == ("reading", [])
    assert all(words in text for words in ("CPU %", "NOT WELL", "its wire is loose", "LOCKED", "reading"))
