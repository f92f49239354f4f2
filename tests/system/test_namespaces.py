"""Several hosts, as network namespaces joined by a cable that can be pulled."""

import contextlib
import json
import os
import secrets
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from system.conftest import ROSIE, Bench, Program, wait_until
from system.member import PROVIDERS
from trade_hil_sim import events

ROUNDS = int(os.environ.get("TRADE_SOAK_ROUNDS", "20"))
MOVER = Path(__file__).with_name("mover.py")
HALFWAY_RAD = 0.65
MEMBER = Path(__file__).with_name("member.py")
pytestmark = pytest.mark.timeout(120 + 15 * ROUNDS)


def ip(*words: str) -> str:
    """Runs ``ip WORDS``; raises CalledProcessError."""
    return subprocess.run(["ip", *words], capture_output=True, text=True, check=True, timeout=20).stdout


def _why_not() -> str:
    """Why there can be no namespaces here; empty if there can."""
    if shutil.which("ip") is None:
        return "there is no `ip` (Debian: iproute2)"
    probe = f"trade-{secrets.token_hex(3)}"
    try:
        ip("netns", "add", probe)
        ip("netns", "exec", probe, "true")
        ip("netns", "del", probe)
    except subprocess.CalledProcessError as refused:
        return f"network namespaces need rights this user has not: {refused.stderr.strip()}"
    return ""


class Member:
    """``member.py`` in one of the namespaces."""

    def __init__(self, namespace: str, name: str, address: str, runtime: Path) -> None:
        command = ["ip", "netns", "exec", namespace, sys.executable, str(MEMBER), name, address]
        # Each namespace is a host of its own: no folder in common.
        environment = {
            **os.environ,
            "TRADE_RUNTIME_DIR": str(runtime / namespace),
            "TRADE_INSECURE_LAN": "1",
            "TRADE_CREDENTIALS": "lab:secret",
        }
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )

    def tell(self, *words: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(words) + "\n")
        self._process.stdin.flush()

    def heard(self) -> Any:
        assert self._process.stdout is not None
        said = json.loads(self._process.stdout.readline())
        assert "error" not in said, said["error"]
        return said["answer"]

    def ask(self, *words: str) -> Any:
        self.tell(*words)
        return self.heard()

    def close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Cable:
    """Two namespaces, ``left`` at 10.231.7.1 and ``right`` at 10.231.7.2, and what joins them."""

    def __init__(self) -> None:
        mark = secrets.token_hex(3)
        self.left, self.right = f"trade-{mark}-l", f"trade-{mark}-r"
        self._ends = {self.left: f"tl{mark}", self.right: f"tr{mark}"}
        for namespace in self._ends:
            ip("netns", "add", namespace)
            ip("-n", namespace, "link", "set", "lo", "up")
        names = list(self._ends.values())
        ip("-n", self.left, "link", "add", names[0], "type", "veth", "peer", "name", names[1], "netns", self.right)
        for (namespace, end), address in zip(self._ends.items(), ("10.231.7.1/24", "10.231.7.2/24"), strict=True):
            ip("-n", namespace, "addr", "add", address, "dev", end)
            ip("-n", namespace, "link", "set", end, "up")
        self._wait_until_up()

    def _wait_until_up(self) -> None:
        """The transport looks at the interfaces once a process: who starts on a dead one never scouts there."""
        while not all("state UP" in ip("-n", namespace, "link", "show", end) for namespace, end in self._ends.items()):
            threading.Event().wait(0.01)

    def pull(self) -> None:
        ip("-n", self.left, "link", "set", self._ends[self.left], "down")

    def plug(self) -> None:
        ip("-n", self.left, "link", "set", self._ends[self.left], "up")

    def close(self) -> None:
        for namespace in self._ends:
            with contextlib.suppress(subprocess.CalledProcessError):
                ip("netns", "del", namespace)


@pytest.fixture
def cable() -> Iterator[Cable]:
    reason = _why_not()
    if reason and os.environ.get("CI") == "true":
        pytest.fail(f"{reason}; in CI this is part of what must hold")
    if reason:
        pytest.skip(reason)
    laid = Cable()
    yield laid
    laid.close()


@pytest.fixture
def member(cable: Cable, system: str, tmp_path: Path) -> Iterator[Callable[[str, str], Member]]:
    started: list[Member] = []

    def start(side: str, name: str) -> Member:
        namespace, address = {"left": (cable.left, "10.231.7.1"), "right": (cable.right, "10.231.7.2")}[side]
        started.append(Member(namespace, name, address, tmp_path))
        return started[-1]

    yield start
    for running in started:
        running.close()


StartMember = Callable[[str, str], Member]


def test_three_that_start_and_register_at_the_same_moment_all_see_everything(member: StartMember) -> None:
    members = [member("left", "a"), member("left", "b"), member("right", "c")]
    expected = [f"{name}.p{number}.echo" for name in "abc" for number in range(PROVIDERS)]
    for turn in range(ROUNDS):
        for each in members:
            each.tell("join_and_register", str(turn))
        for each in members:
            each.heard()
        for _ in range(2):  # who saw everything first still does when the last one has
            for each in members:
                each.tell("sees", str(len(expected)))
            seen = [each.heard() for each in members]
            assert seen == [expected] * 3, f"round {turn}: {[each.ask('state') for each in members]}"
        called = [each.ask("call_all") for each in members]
        assert called == [len(expected)] * 3, f"round {turn}: {[each.ask('state') for each in members]}"
        for each in members:
            each.ask("stop")


def test_discovery_links_hosts_by_multicast(member: StartMember) -> None:
    left, right = member("left", "a"), member("right", "b")
    for each in (left, right):
        each.ask("start")
        each.ask("register")
    assert len(left.ask("sees", str(PROVIDERS))) == PROVIDERS
    left.ask("find_each_other")
    right.ask("find_each_other")
    assert len(left.ask("sees", str(2 * PROVIDERS))) == 2 * PROVIDERS
    assert right.ask("sees", str(2 * PROVIDERS)) == left.ask("sees", str(2 * PROVIDERS))
    assert left.ask("call_all") == right.ask("call_all") == 2 * PROVIDERS


@pytest.mark.parametrize("linked_by", ["find_each_other", "connect", "settings"])
def test_services_come_back_after_a_partition_without_a_restart(
    cable: Cable, member: StartMember, linked_by: str
) -> None:
    left, right = member("left", "a"), member("right", "b")
    endpoint = left.ask("start")
    right.ask("start", *([endpoint] if linked_by == "settings" else []))
    for each in (left, right):
        each.ask("register")
        if linked_by == "find_each_other":
            each.ask("find_each_other")
    if linked_by == "connect":
        right.ask("connect", endpoint)
    for each in (left, right):
        assert len(each.ask("sees", str(2 * PROVIDERS))) == 2 * PROVIDERS
    for _ in range(2):
        cable.pull()
        for each in (left, right):
            assert len(each.ask("sees", str(PROVIDERS))) == PROVIDERS
        cable.plug()
        for each in (left, right):
            assert len(each.ask("sees", str(2 * PROVIDERS))) == 2 * PROVIDERS
            assert each.ask("call_all") == 2 * PROVIDERS


def test_S05_what_a_client_moves_stops_when_its_link_is_cut(
    cable: Cable,
    benches: Callable[..., Bench],
    run: Callable[..., Program],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TRADE_INSECURE_LAN", "1")
    monkeypatch.setenv("TRADE_CREDENTIALS", "lab:secret")
    monkeypatch.setenv("TRADE_LISTEN", "tcp/10.231.7.1:7447")
    bench = benches(ROSIE, inside=cable.left)
    monkeypatch.setenv("TRADE_RUNTIME_DIR", str(tmp_path / "right"))
    monkeypatch.setenv("TRADE_LISTEN", "tcp/10.231.7.2:0")
    monkeypatch.setenv("TRADE_CONNECT", "tcp/10.231.7.1:7447")
    run(MOVER, "call", inside=cable.right).json()
    wait_until(lambda: bool(events(bench.sim.entries(), "motion_started", device_id=1)))
    cut_at = time.monotonic()
    cable.pull()
    bench.stopped_short(cut_at, HALFWAY_RAD)
