"""The judge on histories made by hand: what is right passes, and each kind of wrong is named."""

import pytest

from tests.endurance.chaos._records import AnyRecord, Beat, Byte, Command, End, Fault, Grant, Renewed
from tests.endurance.chaos._verify import verify
from tests.support.lock_log import Ask, Done, Held, Seen

pytestmark = pytest.mark.slow


def lock(hold: str, *times: float, resource: str = "a") -> list[AnyRecord]:
    """Asked, held, seen, ..., given back."""
    asked, held, *seen, done = times
    return [
        Ask(t=asked, hold=hold, resources=(resource,)),
        Held(t=held, hold=hold),
        *(Seen(t=t, hold=hold) for t in seen),
        Done(t=done, hold=hold, how="given back"),
    ]


def write(hold: str, t: float, *byte_times: float, grants: tuple[int, ...] = ()) -> list[AnyRecord]:
    """A command that passed the gate, and its bytes."""
    command = Command(t=t, epoch="e", resource="a", hold=hold, grants=grants)
    return [command, *(Byte(t=at, epoch="e", resource="a", hold=hold, command_t=t) for at in byte_times)]


def grant(number: int, t: float, until: float | None, lease_s: float = 1.0) -> list[AnyRecord]:
    granted = Grant(t=t, epoch="e", number=number, resources=("a",), lease_s=lease_s)
    ended = [] if until is None else [End(t=until, epoch="e", number=number, after_t=until + 0.001)]
    return [granted, *ended]


def wrong(*histories: list[AnyRecord]) -> list[str]:
    return verify([record for history in histories for record in history]).violations


TURNS = [
    *grant(1, 1.0, 2.0),
    *lock("one", 0.5, 1.1, 1.2, 1.8, 2.1),
    *write("one", 1.3, 1.4, 1.5, grants=(1,)),
    *grant(2, 3.0, 4.0),
    *lock("two", 0.6, 3.1, 3.9, 4.1),
    *write("two", 3.2, 3.3, grants=(2,)),
    *write("free", 5.0, 5.1),
]


def test_two_owners_that_take_turns_do_nothing_wrong() -> None:
    assert wrong(TURNS) == []


def test_faults_grants_and_outcomes_are_counted() -> None:
    verdict = verify([*TURNS, Fault(t=0.0, what="kill", process="x")])
    names = ("grant", "byte", "done given back", "fault kill")
    assert [verdict.counts[name] for name in names] == [2, 4, 2, 1]


def test_two_owners_at_a_time() -> None:
    assert wrong(lock("one", 0, 1, 3, 4), lock("two", 0, 2.9, 3.5, 4)) == ["a has two owners at 2.900000: one and two"]
    assert wrong(lock("one", 0, 1, 3, 4), lock("two", 0, 3.1, 3.5, 4)) == []
    assert wrong(lock("one", 0, 1, 3, 4), lock("two", 0, 2.9, 3.5, 4, resource="b")) == []


def test_two_owners_are_found_behind_a_third_one_within() -> None:
    several = [lock("one", 0, 1, 9, 10), lock("two", 0, 2, 3, 4), lock("three", 0, 5, 6, 7)]
    assert len(wrong(*several)) == 2


def test_a_write_without_the_lock_is_a_violation_while_another_client_holds_it() -> None:
    assert any("got a byte of free" in text for text in wrong(lock("one", 0, 1, 3, 4), write("free", 1.5, 2.0)))
    assert wrong(lock("one", 0, 1, 3, 4), write("free", 3.1, 3.2)) == []


def test_a_byte_after_a_newer_grant_though_its_owner_had_none_of_it_yet() -> None:
    history = [*grant(1, 1.0, 1.4), *write("one", 1.3, 1.35, 1.6, grants=(1,)), *grant(2, 1.5, 2.0)]
    assert wrong(history) == ["a got a byte of one at 1.600000, after a newer grant"]


def test_a_command_that_passed_the_gate_after_its_grant_had_ended() -> None:
    assert wrong([*grant(1, 1.0, 2.0), *write("one", 2.1, grants=(1,))]) == [
        "one commanded a at 2.100000, after its grant had ended"
    ]
    assert wrong([*grant(1, 1.0, 2.0), *write("one", 1.9, 2.1, grants=(1,))]) == []  # the gate came first


def test_a_command_without_a_grant_while_one_holds() -> None:
    assert wrong([*grant(1, 1.0, 2.0), *write("free", 1.5)]) == [
        "free commanded a at 1.500000, without the grant that held"
    ]
    assert wrong([*grant(1, 1.0, 2.0), *write("free", 1.5, grants=(7,))]) != []


def beats(*spans: tuple[float, float]) -> list[AnyRecord]:
    times = [since + 0.05 * step for since, until in spans for step in range(int((until - since) / 0.05) + 1)]
    return [Beat(t=t, epoch="e") for t in times]


def test_a_grant_that_outlives_its_lease() -> None:
    assert wrong(grant(1, 1.0, 3.5), beats((0, 5))) == ["grant 1 lasted 2.50 s after its last lease of 1 s began"]
    assert wrong(grant(1, 1.0, None), beats((0, 5))) != []
    assert wrong(grant(1, 1.0, 3.5), [Renewed(t=2.0, epoch="e", numbers=(1,))], beats((0, 5))) == []


def test_time_while_a_driver_was_frozen_does_not_count() -> None:
    assert wrong(grant(1, 1.0, 4.5), beats((0, 1.5), (4.0, 5))) == []
    assert wrong(grant(1, 1.0, 4.5), beats((0, 1.5))) == []  # it had to end as it was thawed
    assert wrong(grant(1, 1.0, 4.5), beats((0, 2.0), (2.2, 5))) != []


def test_a_request_that_never_ends_unless_its_process_was_killed() -> None:
    asked: list[AnyRecord] = [Ask(t=1.0, hold="c1-1:2:lock:3", resources=("a",))]
    assert wrong(asked) == ["c1-1:2:lock:3 asked at 1.000000 and never heard anything"]
    assert wrong(asked, [Fault(t=2.0, what="kill", process="c1-1")]) == []
    assert wrong(asked, [Fault(t=2.0, what="kill", process="c1-2")]) != []
