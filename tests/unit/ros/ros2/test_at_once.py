"""A queue that handles its items at once."""

import threading

import pytest

from tests.support.waiting import wait_until
from trade_gateway.ros._mailbox import AtOnce


class Hanging:
    """Takes any number of items at a time; those that should hang do so until the test lets them."""

    def __init__(self, *hang: str) -> None:
        self.reported: list[str] = []
        self.go_on = threading.Event()
        self._hang = hang

    def __call__(self, item: str) -> None:
        self.reported.append(item)
        if item in self._hang:
            assert self.go_on.wait(60)


def test_S07_one_that_hangs_delays_no_other() -> None:
    hanging = Hanging("first", "second")
    at_once = AtOnce[str]("test", hanging, most=3, drop=lambda _: None)
    for item in ("first", "second", "third", "fourth"):
        at_once.put(item)
        wait_until(lambda item=item: item in hanging.reported, f"the {item} is handled")
    hanging.go_on.set()
    at_once.close()


def test_threads_are_limited_and_waiting_listeners_are_notified_later() -> None:
    hanging, dropped = Hanging("first", "second"), []
    at_once = AtOnce[str]("test", hanging, most=2, drop=dropped.append)
    for item in ("first", "second", "third", "fourth"):
        at_once.put(item)
    wait_until(lambda: len(hanging.reported) == 2, "as many are handled as there are threads")
    assert (len(at_once._threads), list(at_once._waiting)) == (2, ["third", "fourth"])
    hanging.go_on.set()
    wait_until(lambda: len(hanging.reported) == 4, "the others are handled")
    wait_until(lambda: not at_once._threads, "the threads have ended")
    at_once.close()
    assert not dropped


def test_what_waits_at_the_end_and_what_comes_after_it_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trade_gateway.ros._mailbox._END_S", 0.0)
    hanging, dropped = Hanging("first"), []
    at_once = AtOnce[str]("test", hanging, most=1, drop=dropped.append)
    at_once.put("first")
    at_once.put("waits")
    at_once.close()
    at_once.close()
    at_once.put("too late")
    hanging.go_on.set()
    wait_until(lambda: not at_once._threads, "the thread has ended")
    assert (hanging.reported, dropped) == (["first"], ["waits", "too late"])


def test_a_listener_may_close_its_own_queue() -> None:
    reported: list[str] = []
    at_once = AtOnce[str]("test", lambda item: (at_once.close(), reported.append(item)), most=1, drop=lambda _: None)
    at_once.put("end")
    wait_until(lambda: reported, "it is handled")


def test_a_failure_is_logged_and_the_next_event_is_delivered(caplog: pytest.LogCaptureFixture) -> None:
    def fail(item: str) -> None:
        raise ValueError(item)

    at_once = AtOnce[str]("its name", fail, most=1, drop=lambda _: None)
    at_once.put("bad")
    at_once.put("also bad")
    at_once.close()
    wait_until(lambda: not at_once._threads, "the thread has ended")
    assert "its name failed" in caplog.text


def test_without_a_thread_it_is_dropped(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def refuse(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    reported, dropped = [], []
    at_once = AtOnce[str]("test", reported.append, most=1, drop=dropped.append)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuse)
        at_once.put("in vain")
    at_once.put("later")
    wait_until(lambda: reported, "the next is handled")
    assert (reported, dropped) == (["later"], ["in vain"])
