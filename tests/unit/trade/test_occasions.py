"""``once``, ``after``, ``at``, ``every``: at this time, if this holds, make that call. By functions and by services."""

import itertools
import logging
import queue
import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Container, Handle, service, where
from trade.errors import ConfigurationError, DeviceSilent, NoSuchNotification
from trade.transport import wait_clock

SOON_S = 0.02


class Dock:
    """A battery and what is done when it is low."""

    def __init__(self) -> None:
        self.low = False
        self.asked = 0
        self.came: queue.SimpleQueue[Any] = queue.SimpleQueue()

    @service(effect="read")
    def is_low(self) -> bool:
        self.asked += 1
        return self.low

    @service(effect="read")
    def level(self) -> float:
        return 0.5

    @service
    def go(self, speed: float = 0.1) -> None:
        self.came.put(speed)

    def next(self) -> Any:
        return self.came.get(timeout=20)


@pytest.fixture
def dock() -> Dock:
    return Dock()


@pytest.fixture
def handle(there: Container, here: Container, dock: Dock) -> Callable[[str], Handle]:
    """Of the dock's services, which are in another container."""
    there.register(dock, "base")
    return lambda name: here.find(where(name=name, group="base"), wait_s=20)


def test_once_makes_the_call_without_waiting_for_it(
    here: Container, dock: Dock, handle: Callable[[str], Handle]
) -> None:
    assert not here.once(handle("go").bind(0.3)).active or dock.next() == 0.3


def test_once_ends_when_it_has_fired(here: Container, dock: Dock, handle: Callable[[str], Handle]) -> None:
    noted = here.once(handle("go"))
    assert dock.next() == 0.1
    wait_until(lambda: not noted.active)
    assert noted.info().state == "ended"
    assert noted.info().fired == 1


def test_after_waits_so_long(here: Container, dock: Dock, handle: Callable[[str], Handle]) -> None:
    began = time.monotonic()
    here.after(0.2, handle("go"))
    dock.next()
    assert time.monotonic() - began >= 0.2


def test_at_waits_for_the_moment(here: Container, dock: Dock, handle: Callable[[str], Handle]) -> None:
    moment = datetime.now(timezone.utc) + timedelta(seconds=0.3)
    here.at(moment, handle("go"))
    dock.next()
    assert datetime.now(timezone.utc) >= moment


def test_at_uses_the_wall_clock_even_when_it_is_set(
    here: Container, dock: Dock, handle: Callable[[str], Handle], monkeypatch: pytest.MonkeyPatch
) -> None:
    noted = here.at(datetime.now(timezone.utc) + timedelta(hours=5), handle("go"))
    assert noted.active
    ahead, real = 6 * 3600, time.time
    monkeypatch.setattr(wait_clock.time, "time", lambda: real() + ahead)
    assert dock.next() == 0.1


def test_at_knows_time_zones(here: Container) -> None:
    far = timezone(timedelta(hours=13))
    noted = here.at(datetime.now(far) + timedelta(minutes=5), print)
    assert "UTC" in repr(noted)
    assert noted.active


def test_every_repeats_until_it_is_cancelled(here: Container, dock: Dock, handle: Callable[[str], Handle]) -> None:
    noted = here.every(SOON_S, handle("go"))
    for _ in range(3):
        dock.next()
    noted.cancel()
    wait_until(lambda: not noted.active)
    fired = noted.info().fired
    time.sleep(5 * SOON_S)
    assert noted.info().fired <= fired + 1  # one may have been under way


def test_ticks_do_not_overlap_and_missed_ones_become_one(here: Container) -> None:
    under_way: list[int] = []
    most = 0

    def slow() -> None:
        nonlocal most
        under_way.append(1)
        most = max(most, len(under_way))
        time.sleep(5 * SOON_S)
        under_way.pop()

    noted = here.every(SOON_S, slow)
    wait_until(lambda: noted.info().fired >= 3)
    noted.cancel()
    assert most == 1
    assert noted.info().merged >= 4


def test_a_slow_call_holds_up_no_other(here: Container) -> None:
    go_on: queue.SimpleQueue[None] = queue.SimpleQueue()
    ticks: queue.SimpleQueue[int] = queue.SimpleQueue()
    here.once(lambda: go_on.get(timeout=20))
    here.every(SOON_S, lambda: ticks.put(1))
    for _ in range(3):
        ticks.get(timeout=20)
    go_on.put(None)


def test_the_only_service_that_fits_may_be_called(here: Container, dock: Dock, handle: Callable[[str], Handle]) -> None:
    handle("go")
    here.once(where(name="go", group="base"))
    assert dock.next() == 0.1


def test_a_service_may_get_notifications_about_others_with_arguments_of_its_own(
    here: Container, there: Container
) -> None:
    class Listener:
        heard: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()

        @service
        def tell(self, came: Handle, word: str) -> None:
            self.heard.put((came.label, word))

    [tell] = there.register(Listener(), "ear")
    here.joined(where(name="go"), here.find(where(name="tell"), wait_s=20).bind("hello"))
    here.register(Dock(), "base")
    assert tell.alive
    assert Listener.heard.get(timeout=20) == ("base.go", "hello")


def test_if_is_evaluated_at_that_moment(here: Container, dock: Dock, handle: Callable[[str], Handle]) -> None:
    noted = here.once(handle("go"), if_=handle("is_low"))
    wait_until(lambda: not noted.active)
    assert dock.asked == 1
    assert dock.came.empty()
    assert noted.info().fired == 0


def test_a_low_battery_sends_the_robot_to_its_dock_at_every_tick_until_it_is_charged(
    here: Container, dock: Dock, handle: Callable[[str], Handle]
) -> None:
    here.every(SOON_S, handle("go"), if_=handle("is_low"))
    wait_until(lambda: dock.asked >= 2)
    assert dock.came.empty()
    dock.low = True
    dock.next()
    dock.next()
    dock.low = False
    asked = dock.asked
    wait_until(lambda: dock.asked >= asked + 3)


def test_on_the_edge_it_fires_once_each_time_the_condition_becomes_true(
    here: Container, dock: Dock, handle: Callable[[str], Handle]
) -> None:
    here.every(SOON_S, handle("go"), if_=handle("is_low"), edge=True)
    for _ in range(2):
        dock.low = True
        dock.next()
        asked = dock.asked
        wait_until(lambda asked=asked: dock.asked >= asked + 3)
        assert dock.came.empty()
        dock.low = False
        asked = dock.asked
        wait_until(lambda asked=asked: dock.asked >= asked + 2)


def test_when_waits_until_it_holds_fires_and_ends(here: Container, dock: Dock, handle: Callable[[str], Handle]) -> None:
    noted = here.once(handle("go"), when=handle("is_low"), poll_s=SOON_S)
    wait_until(lambda: dock.asked >= 3)
    assert noted.info().state == "waiting"
    assert dock.came.empty()
    dock.low = True
    dock.next()
    wait_until(lambda: not noted.active)
    asked = dock.asked
    time.sleep(3 * SOON_S)
    assert dock.asked == asked


def test_after_counts_from_when_its_condition_holds(
    here: Container, dock: Dock, handle: Callable[[str], Handle]
) -> None:
    here.after(0.2, handle("go"), when=handle("is_low"), poll_s=SOON_S)
    wait_until(lambda: dock.asked >= 3)
    began, dock.low = time.monotonic(), True
    dock.next()
    assert time.monotonic() - began >= 0.2


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda here: here.every(0, print), "s must be seconds, from 0.001"),
        (lambda here: here.every(float("nan"), print), "s must be seconds"),
        (lambda here: here.after(-1, print), "s must be seconds, from 0"),
        (lambda here: here.once(print, when=bool, poll_s=0), "poll_s must be seconds, from 0.001"),
        (lambda here: here.at(datetime.now(timezone.utc) - timedelta(seconds=9), print), "has passed, 9"),
        (lambda here: here.at(datetime.now(), print), "has no time zone"),  # noqa: DTZ005
        (lambda here: here.at("noon", print), "the time must be a datetime, not 'noon'"),
        (lambda here: here.once(7), "call must be a handle"),
        (lambda here: here.once("rosie..go"), r"trade\.once 'rosie\.\.go': .* is no group"),
        (lambda here: here.joined(7, print), r"trade\.joined: say which services"),
        (lambda here: here.once(print, if_=True), "a condition must be a handle"),
        (lambda here: here.every(1, print, if_=lambda _percent: True), "a condition is called without arguments"),
        (lambda here: here.every(1, print, when=lambda _percent: True), "a condition is called without arguments"),
        (lambda here: here.every(1, lambda _handle: None), "call is called without arguments"),
        (lambda here: here.joined(where(name="go"), lambda: None), "call is called with one argument"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_invalid_trigger_is_refused(here: Container, ask: Callable[[Container], Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        ask(here)
    assert here.notifications() == []


def test_a_condition_that_is_neither_true_nor_false_does_not_hold_and_is_reported(
    here: Container, dock: Dock, handle: Callable[[str], Handle], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "trade"):
        noted = here.every(SOON_S, handle("go"), if_=handle("level"))
        wait_until(lambda: noted.info().failures >= 3)
    assert "returns True or False, not 0.5" in noted.info().last_error
    assert dock.came.empty()
    assert caplog.text.count("it stays attached") == 1  # the same again says nothing new


def test_what_happens_once_and_fails_is_not_said_to_stay(here: Container, caplog: pytest.LogCaptureFixture) -> None:
    def fails() -> None:
        raise RuntimeError("no")

    with caplog.at_level(logging.WARNING, "trade"):
        noted = here.once(call=fails)
        wait_until(lambda: noted.info().state == "ended")
    assert "failed" in caplog.text
    assert "it stays attached" not in caplog.text


def test_each_kind_of_failure_is_reported_once_with_its_subject(
    here: Container, caplog: pytest.LogCaptureFixture
) -> None:
    asked, called = itertools.count(), itertools.count()

    def holds() -> bool:
        count = next(asked)
        if count % 2:
            raise DeviceSilent(device="neck.pan", bus="/dev/ttyUSB0", waited_s=float(count))
        if count % 4:
            raise OSError(f"disk {count}")
        return True

    def go() -> None:
        raise OSError(f"no coffee {next(called)}")

    with caplog.at_level(logging.WARNING, "trade"):
        noted = here.every(SOON_S, go, if_=holds)
        wait_until(lambda: noted.info().failures >= 12)
        noted.cancel()
    reported = [one for one in caplog.messages if noted.id in one]
    assert [sum(f"the {part} of" in one for one in reported) for part in ("condition", "call")] == [2, 1]
    assert "holds" in next(one for one in reported if "the condition of" in one)


def test_a_callback_that_fails_kills_nothing(here: Container) -> None:
    ticks: queue.SimpleQueue[int] = queue.SimpleQueue()

    def fail() -> None:
        ticks.put(1)
        raise OSError("no coffee")

    noted = here.every(SOON_S, fail)
    for _ in range(3):
        ticks.get(timeout=20)
    wait_until(lambda: noted.info().failures >= 2)
    assert noted.active
    assert noted.info().last_error == "OSError: no coffee"


def test_a_callback_whose_service_is_gone_is_reported(
    here: Container, there: Container, handle: Callable[[str], Handle]
) -> None:
    go = handle("go")
    there.close()
    noted = here.every(SOON_S, go)
    wait_until(lambda: noted.info().failures >= 2)
    assert noted.info().last_error.startswith("ServiceGone: base.go is gone")


def test_it_may_cancel_itself(here: Container) -> None:
    fired: list[int] = []

    def once_only() -> None:
        fired.append(1)
        noted.cancel()

    noted = here.every(SOON_S, once_only)
    wait_until(lambda: not noted.active)
    time.sleep(3 * SOON_S)
    assert fired == [1]
    assert noted.info().state == "cancelled"


def test_all_are_listed_everywhere_and_cancelled_from_anywhere(
    here: Container, there: Container, handle: Callable[[str], Handle]
) -> None:
    mine = here.every(60, handle("go").bind(0.2), if_=handle("is_low"))
    [info] = there.notifications()
    assert info.id == mine.id
    assert (info.occasion, info.call, info.condition) == ("every 60 s", "base.go(0.2)", "if base.is_low()")
    assert (info.container, info.owner) == (here.name, here.session)
    there.cancel_notification(info.id)
    assert not mine.active
    assert there.notifications() == []
    with pytest.raises(NoSuchNotification, match=info.id):
        there.cancel_notification(info.id)


def test_one_may_live_in_another_container(
    here: Container, there: Container, dock: Dock, handle: Callable[[str], Handle]
) -> None:
    noted = here.every(SOON_S, handle("go").bind(0.4), host=there.name)
    assert dock.next() == 0.4
    [info] = here.notifications()
    assert (info.container, info.owner) == (there.name, here.session)
    noted.cancel()
    assert not noted.active


def test_a_notification_ends_with_its_owner(
    here: Container, there: Container, start_container: Any, handle: Callable[[str], Handle]
) -> None:
    brief = start_container("brief")
    go = brief.find(where(name="go"), wait_s=20)
    brief.every(60, go, host=there.name)
    assert len(there.notifications()) == 1
    brief.close()
    wait_until(lambda: there.notifications() == [])


def test_a_detached_notification_outlives_its_owner(
    here: Container, there: Container, start_container: Any, dock: Dock, handle: Callable[[str], Handle]
) -> None:
    brief = start_container("brief")
    noted = brief.every(SOON_S, brief.find(where(name="go"), wait_s=20), host=there.name)
    noted.detach()
    brief.close()
    wait_until(lambda: len(here.containers()) == 2)
    for _ in range(3):
        dock.next()
    [info] = here.notifications()
    assert info.detached
    here.cancel_notification(info.id)


def test_a_notification_cannot_outlive_its_own_container(here: Container) -> None:
    with pytest.raises(ConfigurationError, match="request it with host="):
        here.every(60, print).detach()


def test_another_container_cannot_call_a_function_of_this_process(here: Container, there: Container) -> None:
    with pytest.raises(ConfigurationError, match="a function of this process; make it a service"):
        here.every(60, print, host=there.name)


def test_a_session_of_a_client_ends_with_its_notifications(here: Container) -> None:
    with here.open_session("page"):
        noted = here.every(60, print)
        assert noted.info().owner.startswith(f"{here.session}/page")
    wait_until(lambda: not noted.active)


def test_the_owner_of_a_notification_gets_its_failures_elsewhere(
    here: Container, there: Container, handle: Callable[[str], Handle], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "trade"):
        here.once(handle("go").bind("fast"), host=there.name)
        wait_until(lambda: "requested here, failed at" in caplog.text)


class Asked:
    """A condition that a test holds up."""

    def __init__(self) -> None:
        self.entered, self.open = threading.Event(), threading.Event()
        self.fired = 0

    @service(effect="read")
    def holds(self) -> bool:
        self.entered.set()
        return self.open.wait(20)

    @service
    def fire(self) -> None:
        self.fired += 1


@pytest.mark.virtual_time
def test_what_is_cancelled_while_its_condition_is_asked_does_not_fire(here: Container, there: Container) -> None:
    asked = Asked()
    there.register(asked, "base")
    fire, holds = (here.find(where(name=name, group="base"), wait_s=20) for name in ("fire", "holds"))
    noted = here.once(fire, when=holds, poll_s=0.02)
    assert asked.entered.wait(20)
    noted.cancel()
    asked.open.set()
    time.sleep(5)
    assert asked.fired == 0
    assert not noted.active
