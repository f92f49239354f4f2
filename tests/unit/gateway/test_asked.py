"""What a signal asks for is heard, wherever the signal strikes."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from trade_gateway.process._signals import SignalEvent

pytestmark = pytest.mark.virtual_time


def test_it_is_heard_by_all_who_wait_and_until_it_is_cleared() -> None:
    asked, heard = SignalEvent(), list[bool]()
    waiting = [threading.Thread(target=lambda: heard.append(asked.wait(PATIENCE_S))) for _ in range(3)]
    for thread in waiting:
        thread.start()
    asked.set()
    for thread in waiting:
        thread.join(PATIENCE_S)
    assert heard == [True] * 3
    assert asked.is_set()
    asked.clear()
    assert not asked.wait(0.01)
    assert not asked.is_set()
    asked.set()
    assert asked.wait()


STRIKES = "import os, sys\nwhile True: os.kill(int(sys.argv[1]), int(sys.argv[2]))"


@pytest.mark.realtime
def test_a_handler_may_set_it_while_its_own_thread_waits_for_it() -> None:
    """With an Event a few thousand signals are enough for one to strike while the thread has its lock."""
    asked, struck = SignalEvent(), [0]

    def handler(_number: int, _frame: object) -> None:
        struck[0] += 1
        asked.set()

    before = signal.signal(signal.SIGUSR1, handler)
    striking = subprocess.Popen([sys.executable, "-c", STRIKES, str(os.getpid()), str(int(signal.SIGUSR1))])
    try:
        wait_until(lambda: [asked.wait(0.0001), asked.clear()] and struck[0] > 5_000, "it was struck often")
    finally:
        striking.kill()
        striking.wait()
        signal.signal(signal.SIGUSR1, before)
