"""Two robots, a gateway and planners on four hosts under every trouble there is; the simulators' logs are the judge."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.holds import Ask, Done, Held, Record, Seen, read

from system.networks import Networks
from system.siege import Stand, stand
from system.siege_judge import judge, motions_of
from system.siege_records import Answer, AnyRecord, Fault, Order
from trade_hil_sim import Entry

SECONDS = 60 * float(os.environ.get("SIEGE_MINUTES", "0.4"))
SEED = int(os.environ.get("SEED", "1"))
KINDS = (
    *("kill planner", "freeze planner", "kill driver", "freeze driver", "unplug"),
    *("kill gateway", "freeze gateway", "cut", "one way", "policy"),
)
FEWEST = 1
pytestmark = pytest.mark.timeout(300 + 3 * SECONDS)


@pytest.fixture
def besieged(networks: Networks, tmp_path: Path) -> Iterator[Stand]:
    with stand(networks, tmp_path, SEED, os.environ.get("SIEGE_MUTANT", "")) as made:
        yield made


def test_nothing_moves_that_must_not_whatever_befalls_them(besieged: Stand) -> None:
    besieged.quiet()
    wrong = besieged.wrong()
    assert not any(wrong.values()), wrong
    before = besieged.held()
    for slot in besieged.planners:
        besieged.restart(slot)
    besieged.siege(SECONDS, FEWEST)
    besieged.quiet()
    logs = {name: driver.sim.entries() for name, driver in besieged.drivers.items()}
    verdict = judge(read(besieged.records, AnyRecord), logs)
    print(f"seed {SEED}:", *(f"  {name:28} {count:6}" for name, count in sorted(verdict.counts.items())), sep="\n")
    assert not verdict.violations, "\n".join(verdict.violations)
    wrong = besieged.wrong()
    assert not any(wrong.values()), f"{wrong}\n{besieged.site.complaints()}"
    for name, (files, threads) in besieged.held().items():
        assert files <= before[name][0] + 30, f"{name} has {files} files open, {before[name][0]} before"
        assert threads <= before[name][1] + 30, f"{name} has {threads} threads, {before[name][1]} before"
    count = verdict.counts
    assert min(count[f"fault {kind}"] for kind in KINDS) >= FEWEST
    assert min(count["held"], count["answer arrived"], count["motion"]) > 5  # it was about something


# --- the judge itself


def begun(t: float, counts: int, since: int = 2048) -> Entry:
    return Entry(
        t=t,
        bus="neck",
        kind="event",
        name="motion_started",
        joint="pan",
        position_counts=since,
        detail=f"goal position {counts}",
    )


def rest(t: float) -> Entry:
    return Entry(t=t, bus="b", kind="event", name="at_rest", joint="pan", position_counts=0)


HOLD = (Ask(t=0, hold="a:1", resources=("rosie.pan",)), Held(t=1, hold="a:1"), Seen(t=8, hold="a:1"))
ORDER = Order(t=2, number="a:2", hold="a:1", resource="rosie.pan", counts=2500, deadline_s=5)
ANSWER = Answer(t=5, number="a:2", how="arrived")
GOOD: tuple[Record, ...] = (*HOLD, ORDER, ANSWER, Done(t=9, hold="a:1", how="given back"))
LATER = (Ask(t=0, hold="b:1", resources=("rosie.pan",)), Held(t=10, hold="b:1"), Seen(t=12, hold="b:1"))
NEXT = (
    Order(t=10.5, number="b:2", hold="b:1", resource="rosie.pan", counts=2700, deadline_s=5),
    Answer(t=12, number="b:2", how="arrived"),
)
EARLIER = (Ask(t=0, hold="b:1", resources=("rosie.pan",)), Held(t=0.5, hold="b:1"), Seen(t=1.5, hold="b:1"))
MOVED = [begun(3, 2500), rest(5)]


@pytest.mark.parametrize(
    ("records", "entries", "says"),
    [
        (GOOD, MOVED, ""),
        (GOOD, [*MOVED, begun(6, 2490, 2500), rest(6.1)], ""),  # it settles
        (GOOD, [begun(3, 2500), begun(4, 2310, 2300), rest(5)], ""),  # stopped on the way
        (GOOD, [*MOVED, begun(6, 3000, 2500), rest(7)], "nobody ordered that"),
        (GOOD, [*MOVED, begun(5.5, 2100, 2500), begun(6, 2500, 2100), rest(7)], "is done again"),
        (GOOD, [begun(7.5, 2500), rest(7.9)], "after its deadline"),
        ((*GOOD, *LATER), [begun(11, 2500), rest(12)], "while b:1 had it"),
        ((*GOOD, *LATER, *NEXT), [begun(3, 2500), begun(11, 2700, 2400), rest(12)], "while it moves for a:1"),
        ((*GOOD, *LATER, *NEXT), [begun(3, 2500), begun(8, 2405, 2400), rest(9), begun(11, 2700, 2405), rest(12)], ""),
        ((*GOOD, *EARLIER), MOVED, "two owners"),
        ((*HOLD, ORDER), MOVED, "after its deadline"),
        ((*HOLD, ORDER, Fault(t=3.5, what="kill planner", whom="a", until=1e12)), MOVED, ""),
        ((HOLD[0],), [], "never heard anything"),
        (
            (*GOOD, Fault(t=3, what="kill driver", whom="rosie", until=1e12)),
            [begun(2.5, 2500), rest(5.5)],
            "and on for 2.5 s",
        ),
        ((*GOOD, Fault(t=3, what="kill driver", whom="dora", until=1e12)), [begun(2.5, 2500), rest(5.5)], ""),
        ((*GOOD, Fault(t=3, what="cut", whom="net1", until=4)), [begun(2.5, 2500), rest(20)], ""),
        ((*GOOD, Fault(t=3, what="cut", whom="net1", until=19)), [begun(2.5, 2500), rest(20)], "after cut net1"),
        ((*GOOD, Fault(t=3, what="kill planner", whom="a", until=1e12)), [begun(2.5, 2500)], "after kill planner a"),
    ],
)
def test_the_judge_knows_what_is_wrong(records: tuple[Any, ...], entries: list[Entry], says: str) -> None:
    found = judge(records, {"rosie": entries}).violations
    if says:
        assert any(says in violation for violation in found), found
    else:
        assert found == []


def test_motions_are_read_from_what_devices_did() -> None:
    [one, two] = motions_of([begun(1, 2500), begun(2, 2300, 2290), rest(3)])["pan"]
    assert one == (1, 2500, 452, 2)
    assert two == (2, 2300, 10, 3)
