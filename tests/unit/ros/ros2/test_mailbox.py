"""A queue that handles its items one at a time."""

import threading
import time

import pytest

from tests.support.waiting import wait_until
from trade_gateway.ros._mailbox import Mailbox

pytestmark = pytest.mark.virtual_time


class Slow:
    """Takes one item at a time, when the test lets it."""

    def __init__(self) -> None:
        self.reported: list[str] = []
        self.busy = threading.Event()
        self.go_on = threading.Event()

    def __call__(self, item: str) -> None:
        self.reported.append(item)
        self.busy.set()
        assert self.go_on.wait(60)


def test_the_oldest_goes_when_there_are_too_many() -> None:
    slow, dropped = Slow(), []
    mailbox = Mailbox[str]("test", slow, most=2, drop=dropped.append)
    mailbox.put("first")
    assert slow.busy.wait(60)
    for item in ("old", "newer", "newest"):
        mailbox.put(item)
    slow.go_on.set()
    wait_until(lambda: len(slow.reported) == 3, "all are handled")
    mailbox.close()
    assert (slow.reported, dropped) == (["first", "newer", "newest"], ["old"])


def test_S01_the_mailbox_drops_messages_that_waited_too_long() -> None:
    slow, dropped = Slow(), []
    mailbox = Mailbox[str]("test", slow, longest_s=0.05, drop=dropped.append)
    mailbox.put("first")
    assert slow.busy.wait(60)
    mailbox.put("late")
    put_at = time.monotonic()
    wait_until(lambda: time.monotonic() > put_at + 0.1, "it is late")
    slow.go_on.set()
    wait_until(lambda: dropped, "it is dropped")
    mailbox.close()
    assert (slow.reported, dropped) == (["first"], ["late"])


def test_what_comes_after_the_end_is_dropped() -> None:
    reported, dropped = [], []
    mailbox = Mailbox[str]("test", reported.append, drop=dropped.append)
    mailbox.close()
    mailbox.close()
    mailbox.put("too late")
    assert (reported, dropped) == ([], ["too late"])


def test_a_listener_may_close_its_own_queue() -> None:
    reported = []
    mailbox = Mailbox[str]("test", lambda item: (reported.append(item), mailbox.close()))
    mailbox.put("end")
    wait_until(lambda: reported, "it is handled")
    mailbox.close()
    assert reported == ["end"]


def test_a_failure_is_logged_and_the_next_event_is_delivered(caplog: pytest.LogCaptureFixture) -> None:
    reported = []

    def tell(item: str) -> None:
        if item == "bad":
            raise ValueError(item)
        reported.append(item)

    mailbox = Mailbox[str]("its name", tell)
    mailbox.put("bad")
    mailbox.put("good")
    wait_until(lambda: reported, "the next is handled")
    mailbox.close()
    assert "its name failed" in caplog.text
