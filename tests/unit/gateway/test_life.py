"""The life of a child, event by event on a clock of the test's own."""

import math
from typing import Any

import pytest

from trade_gateway.config._children import Supervised
from trade_gateway.supervisor._restart_policy import ChildLife, State, Transition


def life(**terms: Any) -> ChildLife:
    return ChildLife(Supervised(providers=[], **{"restarts": 3, "window_s": 60.0, "answers_within_s": 4.0, **terms}))


def up(**terms: Any) -> ChildLife:
    """One that is up at 10 s."""
    made = life(**terms)
    assert made.start(0.0) is Transition.LAUNCH
    assert made.state is State.STARTING
    made.up(10.0)
    assert made.state is State.UP
    return made


def test_a_child_that_answers_its_health_checks_stays_up() -> None:
    child, asked = up(), []
    while len(asked) < 5:
        now = child.deadline
        assert child.due(now) is Transition.ASK
        assert child.deadline == math.inf  # one question at a time
        asked.append(now)
        child.answered(now + 0.25)
    assert asked == [11.0, 12.0, 13.0, 14.0, 15.0]
    assert child.state is State.UP


def test_children_with_the_same_settings_are_asked_at_the_same_moments() -> None:
    early, late = life(), life()
    for child, now in ((early, 10.1), (late, 10.8)):
        child.start(0.0)
        child.up(now)
    assert early.deadline == late.deadline == 11.0
    early.due(11.0)
    early.answered(11.4)
    late.due(11.0)
    late.answered(11.9)
    assert early.deadline == late.deadline == 12.0


def test_a_child_that_misses_a_health_check_is_asked_again_at_once_until_it_has_missed_all() -> None:
    child, asked = up(), []
    for _ in range(child.terms.misses):
        asked.append(child.deadline)
        assert child.due(child.deadline) is Transition.ASK
        child.missed(asked[-1] + 1)
    assert asked == [11.0, 12.0, 13.0, 14.0]
    assert child.state is State.STOPPING  # at 15 s: four after it was asked first


def test_a_child_that_misses_a_health_check_is_silent_and_up_again_with_the_next_answer() -> None:
    child = up()
    for _ in range(10):
        child.due(now := child.deadline)
        assert child.missed(now + 1) is None
        assert child.state is State.SILENT
        child.due(now := child.deadline)
        child.answered(now)
        assert child.state is State.UP


def test_a_child_that_never_answers_is_asked_to_end_then_killed_and_restarted() -> None:
    child = up()
    for _ in range(child.terms.misses - 1):
        child.due(child.deadline)
        assert child.missed(child.deadline if child.deadline < math.inf else 0.0) is None
    child.due(child.deadline)
    assert child.missed(20.0) is Transition.LEAVE  # its state is not asked for: it does not answer
    assert (child.state, child.why) == (State.STOPPING, "it did not answer within 4 s")
    assert child.due(child.deadline) is Transition.KILL
    assert child.deadline == math.inf
    assert child.ended(50.0, "crashed (signal 9)") is None
    assert (child.state, child.why) == (State.WAITING, "it did not answer within 4 s; it crashed (signal 9)")
    assert child.due(child.deadline) is Transition.LAUNCH
    assert child.restarts == 1


def test_a_supervisor_that_was_suspended_counts_no_health_check_that_it_did_not_make() -> None:
    child = up()
    assert child.due(100_000.0) is Transition.ASK
    child.missed(100_000.0)
    assert child.state is State.SILENT
    assert child.due(200_000.0) is Transition.ASK
    child.answered(200_000.0)
    assert child.state is State.UP


def test_the_wait_doubles_and_after_too_many_ends_in_the_window_it_is_given_up() -> None:
    child, waits = life(restarts=3), []
    child.start(0.0)
    for now in (1.0, 2.0, 3.0):
        child.ended(now, "code 1")
        assert child.state is State.WAITING
        waits.append(child.wait_s)
        assert child.due(child.deadline) is Transition.LAUNCH
    assert waits == [0.05, 0.1, 0.2]
    child.ended(4.0, "code 1: no such port")
    assert (child.state, child.why, child.deadline) == (State.GIVEN_UP, "code 1: no such port", math.inf)
    assert child.due(1e9) is None


def test_ends_beyond_the_window_are_forgotten_and_the_wait_is_bounded() -> None:
    child = life(restarts=1, window_s=10.0)
    child.start(0.0)
    for now in range(100, 1000, 100):
        child.ended(float(now), "signal 9")
        assert (child.state, child.wait_s) == (State.WAITING, 0.05)
        child.due(child.deadline)
    patient = life(restarts=1000, window_s=1e9)
    patient.start(0.0)
    for now in range(30):
        patient.ended(float(now), "signal 9")
        patient.due(patient.deadline)
    assert patient.wait_s == 30.0


@pytest.mark.parametrize("how", ["given up", "waiting", "stopped"])
def test_a_start_by_hand_is_immediate_and_resets_the_counters(how: str) -> None:
    child = life(restarts=0 if how == "given up" else 1, restart="never" if how == "stopped" else "always")
    child.start(0.0)
    child.ended(1.0, "signal 9")
    assert child.state.value == how
    assert child.start(2.0) is Transition.LAUNCH
    child.up(3.0)
    assert child.state is State.UP


def test_a_running_child_is_saved_ended_and_restarted_by_hand_without_a_failure() -> None:
    child = up(restarts=0)
    assert child.start(20.0) is Transition.SAVE
    assert child.saved(21.0) is Transition.LEAVE
    assert child.saved(21.5) is None  # twice said is once done
    assert child.ended(22.0, "code 0") is Transition.LAUNCH
    assert (child.state, child.restarts) == (State.STARTING, 1)
    child.up(23.0)
    child.ended(24.0, "signal 11")
    assert child.state is State.GIVEN_UP


def test_a_save_that_does_not_end_delays_no_shutdown() -> None:
    child = up()
    assert child.stop(20.0, "the gateway leaves") is Transition.SAVE
    assert child.due(child.deadline) is Transition.LEAVE
    assert child.saved(40.0) is None
    assert child.due(child.deadline) is Transition.KILL


def test_a_stopped_child_stays_stopped_whatever_its_state_was() -> None:
    waiting = life()
    waiting.start(0.0)
    waiting.ended(1.0, "signal 9")
    assert waiting.stop(1.0, "not wanted") is None
    assert (waiting.state, waiting.deadline) == (State.STOPPED, math.inf)
    starting = life()
    starting.start(0.0)
    assert starting.stop(1.0, "not wanted") is Transition.LEAVE
    starting.up(2.0)
    assert starting.state is State.STOPPING
    assert starting.ended(3.0, "code 0") is None
    assert starting.state is State.STOPPED


def test_the_last_request_decides_what_becomes_of_a_child_that_is_ending() -> None:
    child = up()
    child.start(20.0)
    assert child.stop(21.0, "not wanted after all") is None
    child.saved(22.0)
    child.ended(23.0, "code 0")
    assert child.state is State.STOPPED


def test_a_child_that_is_not_up_in_time_is_ended_and_started_again() -> None:
    child = life()
    child.start(0.0)
    assert child.due(child.deadline) is Transition.LEAVE
    child.ended(61.0, "ended (exit code 0)")
    assert (child.state, child.why) == (State.WAITING, "it was not up within 60 s; it ended (exit code 0)")


def test_a_child_that_takes_too_much_memory_is_saved_ended_and_started_again() -> None:
    child = up()
    assert child.fail(20.0, "it took 600 MB of memory") is Transition.SAVE
    child.saved(20.0)
    child.ended(21.0, "ended (exit code 0)")
    assert (child.state, child.why) == (State.WAITING, "it took 600 MB of memory; it ended (exit code 0)")


def launched(child: ChildLife, now: float) -> float:
    """Starts it as soon as it is due; returns the time."""
    if child.state is State.WAITING:
        now = child.deadline
        assert child.due(now) is Transition.LAUNCH
    assert child.state is State.STARTING
    return now


def test_a_child_whose_device_is_absent_is_started_again_without_limit() -> None:
    child, now, waits = life(), 0.0, list[float]()
    child.start(now)
    for _ in range(500):
        now = launched(child, now) + 1.0
        child.ended(now, "ended (exit code 75)", absent=True)
        assert child.state is State.WAITING
        waits.append(child.wait_s)
    assert waits[:3] == [0.05, 0.1, 0.2]
    assert set(waits[10:]) == {30.0}
    launched(child, now)
    child.up(child.deadline)
    assert child.state is State.UP


@pytest.mark.parametrize("absences", [0, 20])
def test_crashes_end_a_child_as_before_and_absences_are_none_of_them(absences: int) -> None:
    child, now = life(window_s=1e6), 0.0
    child.start(now)
    for _ in range(absences):
        now = launched(child, now)
        child.ended(now, "ended (exit code 75)", absent=True)
    for crash in range(4):
        assert child.state is not State.GIVEN_UP, crash
        now = launched(child, now)
        child.ended(now, "crashed (signal 11)")
    assert child.state is State.GIVEN_UP


def test_a_child_that_was_up_and_ends_with_that_code_has_crashed() -> None:
    child = up(restarts=0)
    child.ended(20.0, "ended (exit code 75)", absent=True)
    assert (child.state, child.absences) == (State.GIVEN_UP, 0)
