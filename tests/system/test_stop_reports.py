"""What the stop line has confirmed is confirmed: the commands wait for no link then, and say so by their exit code."""

import os
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from trade import Container, Settings, service

Command = Callable[..., "subprocess.CompletedProcess[str]"]
REFUSING = "tcp/127.0.0.1:1"


class Lamp:
    def __init__(self) -> None:
        self.stops = 0

    @service
    def on(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None:
        self.stops += 1


@pytest.fixture
def lamp(start_container: Callable[..., Container]) -> Lamp:
    lamp = Lamp()
    start_container("robot").register(lamp, groups=["rosie.lamp"])
    return lamp


@pytest.fixture(params=["refusing", "silent"])
def dead(request: pytest.FixtureRequest) -> Iterator[str]:
    """An endpoint where nothing listens, or where not even a refusal comes back."""
    if request.param == "refusing":
        yield REFUSING
        return
    with ExitStack() as opened:
        full = opened.enter_context(socket.socket())
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        for _ in range(4):
            waiting = opened.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(full.getsockname())
        yield f"tcp/127.0.0.1:{full.getsockname()[1]}"


@pytest.mark.parametrize("words", [["stop", "rosie"], ["estop"], ["call", "rosie.lamp.stop"]], ids=lambda one: one[0])
def test_S07_what_the_stop_line_confirmed_is_confirmed_though_no_endpoint_answers(
    trade_command: Command, lamp: Lamp, words: list[str], dead: str
) -> None:
    said = trade_command("--connect", dead, *words)
    assert said.returncode == 0, said.stderr
    assert "not stopped" not in said.stdout + said.stderr
    assert lamp.stops >= 1
    if words[0] == "estop":
        assert f"{dead} (TRADE_CONNECT) does not answer" in said.stderr


def test_S09_an_estop_that_no_stop_line_confirms_fails_at_a_dead_endpoint(trade_command: Command, system: str) -> None:
    """The control."""
    said = trade_command("--connect", REFUSING, "estop", "--limit", "0.5")
    assert said.returncode == 1


@pytest.mark.parametrize("words", [["stop", "rosie"], ["estop"], ["estop", "--clear"]], ids=" ".join)
def test_a_command_that_finds_nothing_names_the_robots_of_this_user_in_other_systems(
    trade_command: Command, lamp: Lamp, system: str, words: list[str]
) -> None:
    said = trade_command("--system", "root@raspberrypi", *words, "--limit", "0.5")
    assert said.returncode == 1
    assert (
        f"system {system} has robot (pid {os.getpid()}); commands reach it with: trade --system {system}" in said.stderr
    )
    assert lamp.stops == 0
    control = trade_command("stop", "rosie")
    assert (control.returncode, " has robot" in control.stderr) == (0, False)


def test_an_estop_that_reaches_a_robot_under_an_earlier_name_says_where_it_is_cleared(
    trade_command: Command, system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lamp = Lamp()
    monkeypatch.delenv("TRADE_SYSTEM")
    with Container(Settings.read(system="tom@oldname", container="robot")) as robot:
        robot.register(lamp, groups=["rosie.lamp"])
        said = trade_command("estop", "--reason", "smoke")
        assert said.returncode == 0, said.stderr
        assert lamp.stops == 1
        assert "commands reach it with: trade --system tom@oldname" in said.stderr
        cleared = trade_command("--system", "tom@oldname", "estop", "--clear")
        assert cleared.returncode == 0, cleared.stderr
        assert not robot.estops()
