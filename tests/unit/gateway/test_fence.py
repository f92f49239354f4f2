"""A process that may stay only so long is ended by the kernel, whatever it does; a lock lasts as long as it does."""

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from trade_gateway.process._kill_timer import TimerLease, uptime_s
from trade_gateway.supervisor._single_instance import alone, is_free

STAYS = """
import os, signal, sys, threading
from trade_gateway.process._parent_watch import end_with_stdin
signal.signal(signal.SIGTERM, lambda *_: os.write(1, b"asked to leave\\n"))  # print may be at work
end_with_stdin(leased=True)
print("up", flush=True)
while True:
    threading.Event().wait(0.05)
"""


class Staying:
    """A process that ignores the request to leave."""

    def __init__(self, *term: float) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", STAYS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.until(*term)

    def until(self, leave_s: float, end_s: float) -> None:
        """From now on."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{TimerLease(uptime_s() + leave_s, uptime_s() + end_s).line()}\n")
        self.process.stdin.flush()

    def says(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


@pytest.fixture
def staying() -> Iterator[Staying]:
    made = Staying(1000.0, 2000.0)
    assert made.says() == "up"
    yield made
    made.close()


@pytest.mark.slow
def test_a_child_that_does_not_end_on_request_is_killed(staying: Staying) -> None:
    staying.until(0.0, 0.5)
    assert staying.says() == "asked to leave"
    assert staying.process.wait(PATIENCE_S) == -signal.SIGKILL


@pytest.mark.slow
def test_S20_a_frozen_process_is_ended_while_it_is_frozen(staying: Staying) -> None:
    staying.until(0.0, 2.0)
    assert staying.says() == "asked to leave"  # so it has heard of both
    staying.process.send_signal(signal.SIGSTOP)
    assert staying.process.wait(PATIENCE_S) == -signal.SIGKILL


@pytest.mark.slow
def test_a_child_that_is_renewed_in_time_stays(staying: Staying) -> None:
    staying.until(0.5, 1.0)
    over_at = uptime_s() + 1.0
    staying.until(500.0, 1000.0)
    wait_until(lambda: uptime_s() > over_at + 0.2, "it would have ended")
    assert staying.process.poll() is None


def test_a_child_ends_with_the_process_that_started_it_whatever_its_orders(staying: Staying) -> None:
    assert staying.process.stdin is not None
    staying.process.stdin.close()
    assert staying.says() == "asked to leave"


def test_a_lock_is_free_when_the_process_that_has_it_has_ended_and_not_before(tmp_path: Path) -> None:
    path, go = tmp_path / "locks" / "a.lock", threading.Event()
    with alone(path) as locked:
        process = subprocess.Popen(["sleep", "1000"], pass_fds=locked)
    try:
        assert not is_free(path)
        with pytest.raises(BlockingIOError, match="the previous process has not ended"), alone(path):
            go.set()
    finally:
        process.kill()
        process.wait()
    assert is_free(path)
    assert not go.is_set()
