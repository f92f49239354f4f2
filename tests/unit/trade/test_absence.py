"""S12: who is out of sight with a bridge is gone after a moment, unless he is back before."""

import queue
import threading
from collections.abc import Iterator

import pytest

from trade._discovery.grace_period import GracePeriods


@pytest.fixture
def told() -> "queue.SimpleQueue[str]":
    return queue.SimpleQueue()


@pytest.fixture
def absences(told: "queue.SimpleQueue[str]") -> Iterator[GracePeriods]:
    made = GracePeriods(told.put, lambda: True, grace_s=0.2)
    yield made
    made.close()


def test_S12_who_does_not_come_back_is_gone_once(absences: GracePeriods, told: "queue.SimpleQueue[str]") -> None:
    absences.begin("me/arm/1")
    absences.begin("me/arm/1")
    absences.begin("me/leg/1")
    assert [told.get(timeout=60), told.get(timeout=60)] == ["me/arm/1", "me/leg/1"]
    assert not absences.end("me/arm/1")  # too late
    assert told.empty()


def test_S12_who_is_back_in_time_was_never_gone(told: "queue.SimpleQueue[str]") -> None:
    patient = GracePeriods(told.put, lambda: True, grace_s=3600.0)
    patient.begin("me/arm/1")
    assert patient.end("me/arm/1")
    assert not patient.end("me/arm/1")
    patient.close()
    assert told.empty()


def test_who_went_without_any_bridge_is_gone_as_soon_as_that_is_sure(told: "queue.SimpleQueue[str]") -> None:
    absences = GracePeriods(told.put, lambda: False, grace_s=3600.0)
    absences.begin("me/arm/1")
    assert told.get(timeout=60) == "me/arm/1"
    absences.close()


def test_closed_grace_periods_report_no_absence(told: "queue.SimpleQueue[str]") -> None:
    absences = GracePeriods(told.put, lambda: True, grace_s=3600.0)
    absences.begin("me/arm/1")
    absences.close()
    absences.begin("me/leg/1")
    assert told.empty()
    assert not [thread for thread in threading.enumerate() if thread.name == "trade-absence"]


def test_a_return_during_the_absence_report_is_handled_after_the_report() -> None:
    """The last report says that the container is present; else it would be forgotten while it lives."""
    telling, told = threading.Event(), threading.Event()
    order: list[str] = []

    def gone(session: str) -> None:
        telling.set()
        assert told.wait(60)
        order.append(f"{session} is gone")

    absences = GracePeriods(gone, lambda: False)
    absences.begin("me/arm/1")
    assert telling.wait(60)

    def back() -> None:
        was_away = absences.end("me/arm/1")
        order.append(f"me/arm/1 is back, {was_away}")

    returning = threading.Thread(target=back)
    returning.start()
    returning.join(0.1)
    told.set()
    returning.join(60)
    absences.close()
    assert order == ["me/arm/1 is gone", "me/arm/1 is back, False"]
