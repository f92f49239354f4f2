"""Motion of those who come by the HTTP gateway ends with them; the judge is the simulator's log of bytes."""

import json
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.http_clients import Client
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import Bench, Program
from trade_hil_sim import events, writes

PAGE = Path(__file__).with_name("page.py")
HALFWAY_RAD = 0.65
"""Where a joint that is not stopped gets to long after everything that stops it should have."""

Run = Callable[..., Program]
Command = Callable[..., subprocess.CompletedProcess[str]]


class HttpProcess:
    """``trade http`` in a process of its own."""

    def __init__(self, run: Run, trade_command: Command, folder: Path) -> None:
        self._tokens, self._command, self._run = folder / "tokens.toml", trade_command, run
        self.token = self.new("anna")
        words = ["http", "--listen", "127.0.0.1:0", "--tokens", self._tokens, "--mcp", "--json"]
        self.program = run("-m", "trade_gateway", *words)
        self.url: str = self.program.json()["url"]

    def new(self, identity: str) -> str:
        made = self._command("http", "token", identity, "--tokens", self._tokens, "--json")
        assert made.returncode == 0, made.stderr
        return json.loads(made.stdout)["token"]

    def page(self, how: str) -> Program:
        page = self._run(PAGE, self.url, self.token, how)
        page.json()
        return page


@pytest.fixture
def http(bench: Bench, run: Run, trade_command: Command, tmp_path: Path) -> HttpProcess:
    made = HttpProcess(run, trade_command, tmp_path)
    client = Client(made.url, made.token)
    wait_until(lambda: client.ask("GET", "/services?group=rosie.neck.pan&name=move_to").body, "it is known")
    return made


@pytest.mark.parametrize(
    ("how", "number"),
    [
        ("socket", signal.SIGTERM),
        ("socket", signal.SIGKILL),
        ("socket", signal.SIGSTOP),
        ("request", signal.SIGKILL),
        ("session", signal.SIGKILL),
        ("session", signal.SIGSTOP),
        ("agent", signal.SIGKILL),
        ("agent", signal.SIGSTOP),
    ],
)
def test_S03_motion_of_a_page_stops_with_it_while_the_http_gateway_runs(
    bench: Bench, http: HttpProcess, how: str, number: int
) -> None:
    page = http.page(how)
    wait_until(lambda: bool(events(bench.sim.entries(), "motion_started", device_id=1)))
    ended_at = time.monotonic()
    page.signal(number)
    try:
        bench.stopped_short(ended_at, HALFWAY_RAD)
        assert not writes(bench.sim.entries(), device_id=2, register="goal_position", since=ended_at)
        assert http.program.process.poll() is None
    finally:
        page.process.kill()


def test_S03_motion_of_a_page_stops_when_the_http_gateway_ends(bench: Bench, http: HttpProcess) -> None:
    http.page("socket")
    wait_until(lambda: bool(events(bench.sim.entries(), "motion_started", device_id=1)))
    ended_at = time.monotonic()
    http.program.signal(signal.SIGKILL)
    bench.stopped_short(ended_at, HALFWAY_RAD)


def test_an_http_gateway_ends_on_sigterm(http: HttpProcess) -> None:
    http.program.signal(signal.SIGTERM)
    assert http.program.process.wait(PATIENCE_S) == 0


def test_an_http_gateway_without_tokens_is_refused(trade_command: Command, tmp_path: Path) -> None:
    refused = trade_command("http", "--listen", "127.0.0.1:0", "--tokens", tmp_path / "none.toml")
    assert refused.returncode == 1
    assert "trade http token" in refused.stderr
    refused = trade_command("http", "--listen", "127.0.0.1:0", "--ask-first", "rosie")
    assert refused.returncode == 1
    assert "Add --mcp" in refused.stderr
