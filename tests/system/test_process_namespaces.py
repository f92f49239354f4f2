"""Containers in process namespaces of their own, as in two containers of Docker with one runtime folder."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from trade._paths import runtime_folder

ROBOT = """
    from trade import Container, Settings, service
    class Lamp:
        @service
        def on(self) -> None: ...
        @service(effect="stop")
        def stop(self) -> None:
            print("stopped", flush=True)
    with Container(Settings.read(container="robot")) as container:
        container.register(Lamp(), groups=["rosie.lamp"])
        print("up", flush=True)
        input()
"""
APART = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child")
Run = Callable[..., "subprocess.Popen[str]"]


def can_be_apart() -> bool:
    if shutil.which("unshare") is None:
        return False
    return subprocess.run([*APART, "true"], check=False, capture_output=True).returncode == 0


@pytest.fixture
def run(system: str) -> Iterator[Run]:
    """Runs Python in a process namespace of its own."""
    if not can_be_apart():
        pytest.skip("process namespaces need unshare (util-linux) and root")
    begun: list[subprocess.Popen[str]] = []

    def run(*arguments: str) -> "subprocess.Popen[str]":
        command = [*APART, sys.executable, *arguments]
        pipe = subprocess.PIPE
        begun.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True))
        return begun[-1]

    yield run
    for one in begun:
        one.kill()
        one.communicate()


def trade(run: Run, *arguments: str) -> tuple[int, str]:
    process = run("-m", "trade_gateway", *arguments)
    out, problems = process.communicate(timeout=60)
    return process.returncode, out + problems


def files(system: str) -> list[Path]:
    return sorted(path for path in (runtime_folder() / system).iterdir() if path.name.startswith((".stop-", "tcp_")))


def robot_of(run: Run) -> "subprocess.Popen[str]":
    robot = run("-c", textwrap.dedent(ROBOT))
    assert robot.stdout is not None
    assert robot.stdout.readline() == "up\n"
    return robot


def test_a_client_in_another_process_namespace_stops_a_robot_and_leaves_its_files(run: Run, system: str) -> None:
    robot = robot_of(run)
    there = files(system)
    assert len(there) == 2
    for command in (["stop", "rosie"], ["services"], ["estop"], ["estop", "--clear"], ["stop", "rosie"]):
        code, said = trade(run, *command)
        assert code == 0, said
        assert files(system) == there
    assert robot.stdout is not None
    assert robot.stdout.readline() == "stopped\n"


def test_a_robot_that_does_not_answer_for_a_while_keeps_its_files(run: Run, system: str) -> None:
    """A program that starts meanwhile takes them away only if the robot's process has ended: the control."""
    robot = robot_of(run)
    there = files(system)
    [process] = map(int, Path(f"/proc/{robot.pid}/task/{robot.pid}/children").read_text().split())
    os.kill(process, signal.SIGSTOP)
    for path in there:
        os.utime(path, (1, 1))
    code, said = trade(run, "stop", "rosie", "--limit", "0.5")
    assert code != 0, said
    assert files(system) == there
    os.kill(process, signal.SIGCONT)
    assert trade(run, "stop", "rosie")[0] == 0
    os.kill(process, signal.SIGKILL)
    robot.communicate()
    assert trade(run, "stop", "rosie", "--limit", "0.5")[0] != 0
    assert files(system) == []
