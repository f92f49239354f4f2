"""Threads that wait for messages wake for little else, and what they then do keeps its deadlines."""

import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from trade import Container, service, where
from trade.transport.timer_slack import read_patiently

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="threads have a timer slack on Linux only")

StartContainer = Callable[..., Container]
_READERS = {"trade-registry", "trade-presence", "trade-answers", "trade-estop", "trade-call", "trade-stop"}
_SECOND_NS = 1_000_000_000


def slack_ns(thread: int | None = None) -> int:
    """Of a thread of this process, or of the one that asks."""
    return int(Path(f"/proc/{thread or threading.get_native_id()}/timerslack_ns").read_text())


def test_a_thread_has_slack_only_while_it_waits_for_a_message() -> None:
    before = slack_ns()
    assert before < _SECOND_NS / 1000
    assert read_patiently(slack_ns) == _SECOND_NS
    assert slack_ns() == before


def test_a_channel_that_ends_takes_the_slack_back() -> None:
    before = slack_ns()
    with pytest.raises(ZeroDivisionError):
        read_patiently(lambda: 1 // 0)
    assert slack_ns() == before


class Robot:
    @service
    def slack(self) -> int:
        return slack_ns()


@pytest.mark.usefixtures("no_local_path")
def test_threads_of_the_transport_wait_with_slack_and_run_providers_without(start_container: StartContainer) -> None:
    here, there = start_container("here"), start_container("there")
    there.register(Robot(), "robot")
    assert here.find(where(name="slack", group="robot"), wait_s=10)() == slack_ns()

    def waiting() -> set[str]:
        threads = [thread for thread in threading.enumerate() if thread.native_id is not None]
        return {thread.name.rstrip("-0123456789") for thread in threads if slack_ns(thread.native_id) == _SECOND_NS}

    wait_until(lambda: waiting() >= _READERS)
