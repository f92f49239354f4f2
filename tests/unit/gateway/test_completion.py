"""Completion of what runs, in a real bash and in the forms of zsh and fish; and the exit codes of what is not found."""

import json
import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest

from trade import Container, Resource, service

TRADE: Final = Path(sys.executable).with_name("trade")
_PATIENCE_S: Final = 60.0


class Head:
    def __init__(self) -> None:
        self.moved = 0

    @service
    def move_to(self, angle_rad: float) -> None:
        self.moved += 1

    @service(effect="read")
    def state(self) -> float:
        return 0.5


class Locked:
    def __init__(self, name: str) -> None:
        self.resources = [Resource(f"{name}.joint")]

    @service
    def move_to(self, angle_rad: float) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def head(start_container: Callable[..., Container]) -> Head:
    made = Head()
    start_container("rosie").register(made, ["rosie.head", "lab"])
    return made


def completed(shell: str, line: str) -> str:
    """What a shell gets to complete a line."""
    words = {
        "bash": {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - (not line.endswith(" ")))},
        "zsh": {"_TYPER_COMPLETE_ARGS": line},
        "fish": {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"},
    }[shell]
    asked = {**os.environ, "_TRADE_COMPLETE": f"complete_{shell}", **words}
    done = subprocess.run([TRADE], env=asked, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    assert done.stderr == ""
    return done.stdout


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("trade call rosie.", ["rosie.head.move_to", "rosie.head.state"]),
        ("trade stream rosie.head.s", ["rosie.head.state"]),
        ("trade lock ", ["lab", "rosie", "rosie.head"]),
        ("trade stop rosie.", ["rosie.head"]),
        ("trade services --group l", ["lab"]),
        ("trade call rosie.head.state --container ", ["rosie"]),
        ("trade call trade.hook", ["trade.hook_suspended", "trade.hooks"]),
        ("trade --system elsewhere call r", []),
        ("trade call nothing", []),
    ],
)
def test_bash_gets_what_runs(head: Head, line: str, words: list[str]) -> None:
    assert completed("bash", line).split() == words
    assert head.moved == 0


@pytest.mark.realtime
def test_zsh_and_fish_get_it_in_their_forms(head: Head) -> None:
    assert '"rosie.head.state"' in completed("zsh", "trade call rosie.head.s")
    assert completed("fish", "trade call rosie.head.s").split() == ["rosie.head.state"]


@pytest.mark.realtime
def test_ids_of_hooks_and_notifications_are_completed(head: Head, start_container: Callable[..., Container]) -> None:
    here = start_container("here")
    hook = here.after_service("rosie.head.state", here.find("rosie.head.move_to", wait_s=20))
    note = here.every(3600, lambda: None)
    assert completed("bash", "trade hooks --detach ").split() == [hook.id]
    assert note.id in completed("bash", "trade notifications --cancel ").split()


@pytest.mark.realtime
def test_only_groups_with_a_lock_are_completed_where_one_is_broken(start_container: Callable[..., Container]) -> None:
    robot = start_container("rosie")
    for name in ("rosie.head", "rosie.tail"):
        robot.register(Locked(name), name)
    assert completed("bash", "trade unlock ").split() == []
    with robot.lock("rosie.tail"):
        assert completed("bash", "trade unlock ").split() == ["rosie", "rosie.tail"]


@pytest.mark.realtime
def test_a_wrong_setting_completes_nothing(head: Head, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_TLS", "/nowhere")
    assert completed("bash", "trade call rosie.").split() == []


class Terminal:
    """A bash in a pseudo-terminal."""

    def __init__(self) -> None:
        environment = {**os.environ, "PATH": f"{TRADE.parent}:{os.environ['PATH']}", "PS1": "READY>", "TERM": "dumb"}
        pid, self._screen = pty.fork()
        if pid == 0:
            os.execvpe("bash", ["bash", "--norc", "--noprofile", "-i"], environment)
        self._pid = pid
        self._shown = ""

    def type(self, text: str) -> None:
        os.write(self._screen, text.encode())

    def shows(self, text: str) -> None:
        """Wait until it shows a text after the last one."""
        until = time.monotonic() + _PATIENCE_S
        while text not in self._shown:
            ready, _, _ = select.select([self._screen], [], [], max(0.0, until - time.monotonic()))
            assert ready, f"no {text!r} in {self._shown!r}"
            self._shown += os.read(self._screen, 4096).decode(errors="replace")
        self._shown = self._shown.partition(text)[2]

    def close(self) -> None:
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)
        os.close(self._screen)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    if shutil.which("bash") is None:
        assert os.environ.get("CI") != "true", "bash is not installed"
        pytest.skip("bash is not installed")
    made = Terminal()
    yield made
    made.close()


@pytest.mark.realtime
def test_a_tab_completes_a_service_in_a_terminal(head: Head, terminal: Terminal) -> None:
    terminal.shows("READY>")
    terminal.type('eval "$(_TRADE_COMPLETE=source_bash trade)"; echo loaded-$?\n')
    terminal.shows("loaded-0")
    terminal.shows("READY>")
    terminal.type("trade call rosie.head.mo\t")
    terminal.shows("rosie.head.move_to")
    assert head.moved == 0


def run(*words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([TRADE, *words], capture_output=True, text=True, timeout=_PATIENCE_S, check=False)


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (("call", "rosie.head.wave", "--wait", "0"), 3, "NoSuchService"),
        (("hooks", "--detach", "1a2b.h1"), 3, "NoSuchHook"),
        (("notifications", "--cancel", "1a2b.1"), 3, "NoSuchNotification"),
        (("call", "rosie.head.move_to", '"up"'), 1, "InvalidArgument"),
        (("call", "rosie.head.state", "--pick", "best"), 2, "UsageError"),
    ],
    ids=["service", "hook", "notification", "argument", "usage"],
)
def test_what_is_not_found_has_an_exit_code_of_its_own(
    head: Head, words: tuple[str, ...], code: int, error: str
) -> None:
    plain, as_json = run(*words), run(*words, "--json")
    assert (plain.returncode, as_json.returncode, as_json.stdout) == (code, code, "")
    assert plain.stderr.startswith(f"{error}: ")
    shown = json.loads(as_json.stderr)
    assert shown["error"] == error
    assert plain.stderr == f"{error}: {shown['message']}\n"
    assert shown["data"]
    assert head.moved == 0


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("words", "code"), [((), 0), (("--group", "rosie"), 0), (("--group", "max"), 3), (("--name", "wave"), 3)]
)
def test_a_list_without_what_was_asked_for_ends_with_that_code(head: Head, words: tuple[str, ...], code: int) -> None:
    assert run("services", *words).returncode == code
    as_json = run("services", *words, "--json")
    assert as_json.returncode == code
    assert bool(json.loads(as_json.stdout)) is (code == 0)


@pytest.mark.realtime
def test_one_of_several_is_called(head: Head, start_container: Callable[..., Container]) -> None:
    start_container("twin").register(Head(), "rosie.head")
    assert run("call", "rosie.head.state").returncode == 1
    picked = run("call", "rosie.head.state", "--pick", "least_busy")
    assert (picked.returncode, picked.stdout) == (0, "0.5\n")
