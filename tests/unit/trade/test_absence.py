"""S12: who is out of sight with a bridge is gone after a moment, unless he is back before."""

import queue
import threading
from collections.abc import Iterator

import pytest

from trade._discovery.grace_period import GracePeriods
from trade._threads.scheduler import Scheduler

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def reported() -> "queue.SimpleQueue[str]":
    return queue.SimpleQueue()


@pytest.fixture
def timers() -> Iterator[Scheduler]:
    made = Scheduler("trade-timers")
    yield made
    made.close()


@pytest.fixture
def absences(reported: "queue.SimpleQueue[str]", timers: Scheduler) -> Iterator[GracePeriods]:
    made = GracePeriods(reported.put, lambda: True, timers, grace_s=0.2)
    yield made
    made.close()


def after(timers: Scheduler, seconds: float) -> None:
    """Return once so much time of the timers has passed."""
    later = threading.Event()
    timers.begin(later.set, timers.clock.now_ns() + int(seconds * 1e9))
    assert later.wait(60)


def test_S12_a_container_that_does_not_come_back_is_reported_gone_once(
    absences: GracePeriods, reported: "queue.SimpleQueue[str]"
) -> None:
    absences.begin("me/arm/1")
    absences.begin("me/arm/1")
    absences.begin("me/leg/1")
    assert [reported.get(timeout=60), reported.get(timeout=60)] == ["me/arm/1", "me/leg/1"]
    assert not absences.end("me/arm/1")  # too late
    assert reported.empty()


def test_S12_a_container_that_is_back_in_time_is_never_reported_gone(
    reported: "queue.SimpleQueue[str]", timers: Scheduler
) -> None:
    patient = GracePeriods(reported.put, lambda: True, timers, grace_s=3600.0)
    patient.begin("me/arm/1")
    assert patient.end("me/arm/1")
    assert not patient.end("me/arm/1")
    patient.close()
    assert reported.empty()


def test_a_container_lost_without_any_bridge_is_gone_as_soon_as_that_is_certain(
    reported: "queue.SimpleQueue[str]", timers: Scheduler
) -> None:
    absences = GracePeriods(reported.put, lambda: False, timers, grace_s=3600.0)
    absences.begin("me/arm/1")
    assert reported.get(timeout=60) == "me/arm/1"
    absences.close()


def test_S12_what_disappears_after_a_bridge_as_such_may_be_out_of_sight_only(
    reported: "queue.SimpleQueue[str]", timers: Scheduler
) -> None:
    """It closes one link after the other, and this container's may be its last."""
    absences = GracePeriods(reported.put, lambda: False, timers, grace_s=3600.0)
    absences.bridge_left()
    absences.begin("me/arm/1")
    after(timers, 3.0)
    absences.begin("me/leg/1")
    assert reported.get(timeout=60) == "me/leg/1", "it disappeared later, so nothing speaks for it"
    assert absences.end("me/arm/1")
    absences.close()
    assert reported.empty()


def test_closed_grace_periods_report_no_absence(
    absences: GracePeriods, reported: "queue.SimpleQueue[str]", timers: Scheduler
) -> None:
    absences.begin("me/arm/1")
    absences.close()
    absences.begin("me/leg/1")
    after(timers, 1.0)
    assert reported.empty()


def test_a_return_during_the_absence_report_is_handled_after_the_report(timers: Scheduler) -> None:
    """The last report says that the container is present; else it would be forgotten while it lives."""
    reporting, reported = threading.Event(), threading.Event()
    order: list[str] = []

    def gone(session: str) -> None:
        reporting.set()
        assert reported.wait(60)
        order.append(f"{session} is gone")

    absences = GracePeriods(gone, lambda: False, timers)
    absences.begin("me/arm/1")
    assert reporting.wait(60)

    def back() -> None:
        was_away = absences.end("me/arm/1")
        order.append(f"me/arm/1 is back, {was_away}")

    returning = threading.Thread(target=back)
    returning.start()
    returning.join(0.1)
    reported.set()
    returning.join(60)
    absences.close()
    assert order == ["me/arm/1 is gone", "me/arm/1 is back, False"]
