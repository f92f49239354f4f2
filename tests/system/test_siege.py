"""Two robots, a gateway and planners on four hosts under every trouble there is; the simulators' logs are the judge."""

import math
import os
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec import structs

from tests.support.lock_log import Ask, Done, Held, Record, Seen, read
from tests.system.networks import Networks
from tests.system.siege import TROUBLES, Stand, stand
from tests.system.siege_judge import judge, motions_of
from tests.system.siege_minimised import fewest
from tests.system.siege_records import Alarm, Answer, AnyRecord, Fault, Order, Rescue
from trade_hil_sim import LogEntry

SECONDS = 60 * float(os.environ.get("SIEGE_MINUTES", "0.4"))
SEED = int(os.environ.get("SEED", "1"))
KINDS = [kind for kind in os.environ.get("SIEGE_KINDS", "").split(",") if kind] or [*TROUBLES]
FEWEST = 1
KEPT = Path("build", f"siege-{SEED}")
pytestmark = pytest.mark.timeout(300 + 3 * SECONDS)


@pytest.fixture
def besieged(networks: Networks, tmp_path: Path) -> Iterator[Stand]:
    with stand(networks, tmp_path, SEED, os.environ.get("SIEGE_MUTANT", "")) as made:
        yield made


def test_nothing_moves_that_must_not_whatever_faults_occur(besieged: Stand) -> None:
    besieged.quiet()
    wrong = besieged.wrong()
    assert not any(wrong.values()), wrong
    before = besieged.held()
    for slot in besieged.clients:
        besieged.restart(slot)
    besieged.siege(SECONDS, FEWEST, KINDS)
    besieged.quiet()
    logs = {name: driver.sim.entries() for name, driver in besieged.drivers.items()}
    verdict = judge(read(besieged.records, AnyRecord), logs)
    count = verdict.counts
    count["held back"] = besieged.held_back()
    print(f"seed {SEED}:", *(f"  {name:36} {many:6}" for name, many in sorted(count.items())), sep="\n")
    if verdict.violations:  # the notes of all processes are the evidence
        shutil.rmtree(KEPT, ignore_errors=True)
        shutil.copytree(besieged.records, KEPT)
        for said in besieged.site.folder.glob("*complaints"):  # of the gateway and the drivers
            shutil.copy(said, KEPT)
        for name, entries in logs.items():
            (KEPT / f"{name}.log.json").write_bytes(msgspec.json.encode(entries))
    assert not verdict.violations, "\n".join([*verdict.violations, f"the notes of all are kept in {KEPT}"])
    wrong = besieged.wrong()
    assert not any(wrong.values()), f"{wrong}\n{besieged.site.complaints()}"
    for name, (files, threads) in besieged.held().items():
        assert files <= before[name][0] + 30, f"{name} has {files} files open, {before[name][0]} before"
        assert threads <= before[name][1] + 30, f"{name} has {threads} threads, {before[name][1]} before"
    assert min(count[f"fault {kind}"] for kind in KINDS) >= FEWEST
    assert min(count["held"], count["answer arrived"], count["order carried out"]) > 5  # it was about something
    assert count["motion of a drive"] > 0
    assert min(count[f"order of a {kind}"] for kind in ("planner", "page", "agent")) > 5
    assert count["held back"] > 0 or "delay" not in KINDS


def begun(t: float, counts: int, since: int = 2048) -> LogEntry:
    return LogEntry(
        t=t,
        bus="neck",
        kind="event",
        name="motion_started",
        joint="pan",
        position_counts=since,
        detail=f"goal position {counts}",
    )


def reported(t: float, counts: int, at: int, speed: int = 83) -> LogEntry:
    """A goal, with its profile: acceleration, velocity, position."""
    return LogEntry(
        t=t,
        bus="neck",
        kind="instruction",
        name="sync_write",
        joint="pan",
        position_counts=at,
        address=108,
        registers=("profile_acceleration", "profile_velocity", "goal_position"),
        hex=b"".join(number.to_bytes(4, "little") for number in (5, speed, counts)).hex(),
    )


def rest(t: float) -> LogEntry:
    return LogEntry(t=t, bus="b", kind="event", name="at_rest", joint="pan", position_counts=0)


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
OF_ROSIE = (
    Ask(t=2, hold="a:1@rosie", resources=("rosie.pan",)),
    Held(t=2, hold="a:1@rosie"),
    Seen(t=4, hold="a:1@rosie"),
)
OF_BOTH = (
    Ask(t=0, hold="a:1", resources=("dora.pan", "rosie.pan")),
    *OF_ROSIE,
    ORDER,
    ANSWER,
    Done(t=9, hold="a:1", how="given back"),
)
DORA = (
    Ask(t=0, hold="b:1", resources=("dora.pan",)),
    Held(t=1, hold="b:1"),
    Seen(t=8, hold="b:1"),
    Done(t=9, hold="b:1", how="given back"),
)
PAGE = (structs.replace(ORDER, number="page4-1:2", hold="page4-1:free"), structs.replace(ANSWER, number="page4-1:2"))
JOG = (structs.replace(ORDER, counts=2961, valid_s=0.2), ANSWER)
STOP = 104
"""How fast who stops is to be."""


@pytest.mark.parametrize(
    ("records", "entries", "says"),
    [
        (GOOD, MOVED, ""),
        (OF_BOTH, MOVED, ""),
        ((*OF_BOTH, *DORA), MOVED, ""),  # that it had the one robot says nothing of the other
        ((*OF_BOTH, *EARLIER, Seen(t=3, hold="b:1")), MOVED, "two owners"),
        (GOOD, [*MOVED, begun(6, 2490, 2500), rest(6.1)], ""),  # it settles
        (GOOD, [begun(3, 2500), reported(4, 2310, 2300, STOP), rest(5)], ""),  # stopped on the way
        (GOOD, [begun(3, 2500), reported(4, 2150, 2300, STOP), rest(5)], ""),  # by who knew only where it had been
        (GOOD, [begun(3, 2500), reported(4, 2150, 2300), rest(5)], "no client ordered that"),
        (GOOD, [begun(3, 2500), reported(4, 2500, 2300), rest(5)], "is done again"),
        (GOOD, [begun(3, 2500), reported(7.5, 2500, 2300), rest(8)], "after its deadline"),
        (GOOD, [*MOVED, begun(6, 3000, 2500), rest(7)], "no client ordered that"),
        (GOOD, [*MOVED, begun(5.5, 2100, 2500), begun(6, 2500, 2100), rest(7)], "is done again"),
        (GOOD, [begun(7.5, 2500), rest(7.9)], "after its deadline"),
        ((*GOOD, *LATER), [begun(11, 2500), rest(12)], "while b:1 had it"),
        ((*GOOD, *LATER, *NEXT), [begun(3, 2500), reported(11, 2700, 2300), rest(12)], "while it moves for a:1"),
        ((*GOOD, *LATER, *NEXT), [begun(3, 2500), reported(11, 2700, 2480), rest(12)], ""),  # it had all but arrived
        (
            (*GOOD, *LATER, *NEXT),
            [begun(3, 2500), reported(8, 2405, 2400, STOP), reported(11, 2700, 2405), rest(12)],
            "",
        ),
        (
            (*GOOD, *LATER, *NEXT),
            [begun(3, 2500), reported(8, 2405, 2400, STOP), rest(9), begun(11, 2700), rest(12)],
            "",
        ),
        ((*GOOD, *EARLIER), MOVED, "two owners"),
        ((*HOLD, ORDER), MOVED, "after its deadline"),
        ((*HOLD, ORDER, Fault(t=3.5, what="kill client", whom="a", until=1e12)), MOVED, ""),
        ((HOLD[0],), [], "never heard anything"),
        (
            (*GOOD, Fault(t=3, what="kill driver", whom="rosie", until=1e12)),
            [begun(2.5, 2500), rest(5.5)],
            "and on for 2.5 s",
        ),
        ((*GOOD, Fault(t=3, what="kill driver", whom="dora", until=1e12)), [begun(2.5, 2500), rest(5.5)], ""),
        ((*GOOD, Fault(t=3, what="bus off", whom="rosie", until=1e12)), [begun(2.5, 2500), rest(5.5)], ""),
        ((*GOOD, Fault(t=3, what="cut", whom="net1", until=4)), [begun(2.5, 2500), rest(20)], ""),
        ((*GOOD, Fault(t=3, what="cut", whom="net1", until=19)), [begun(2.5, 2500), rest(20)], "after cut net1"),
        ((*GOOD, Fault(t=3, what="kill client", whom="a", until=1e12)), [begun(2.5, 2500)], "after kill client a"),
        ((*GOOD, Fault(t=3, what="kill http gateway", whom="hall", until=1e12)), [begun(2.5, 2500), rest(20)], ""),
        (
            (*PAGE, Fault(t=3, what="kill http gateway", whom="hall", until=1e12)),
            [begun(2.5, 2500), rest(20)],
            "kill http gateway",
        ),
        (PAGE, [begun(8.5, 2500), rest(9)], "after its deadline"),
        ((*PAGE, Fault(t=3, what="freeze http gateway", whom="hall", until=5)), [begun(8.5, 2500), rest(9)], ""),
        (JOG, [begun(3, 2961), rest(3.5)], ""),
        (JOG, [begun(3, 2961), rest(6)], "which was to hold for 0.2 s"),
    ],
)
def test_the_judge_knows_what_is_wrong(records: tuple[Any, ...], entries: list[LogEntry], says: str) -> None:
    found = judge(records, {"rosie": entries}).violations
    if says:
        assert any(says in violation for violation in found), found
    else:
        assert found == []


def test_motions_are_derived_from_commands_and_device_events() -> None:
    entries = [
        reported(0.5, 2100, 2048),
        begun(1, 2500),
        reported(2, 2300, 2290, STOP),
        reported(2.1, 1500, 2301),
        rest(3),
    ]
    [one, two] = motions_of([*entries, reported(4, 2000, 1500)])["pan"]  # its torque is off, or whatever: it stayed
    assert one == (1, 2500, 2048, 2.1, True, False)
    assert two == (2.1, 1500, 2301, 3, False, True)
    assert two.far == 801


def commanded(t: float, word: int, counts: int, at: int) -> LogEntry:
    """A drive's first RPDO."""
    return LogEntry(
        t=t,
        bus="leg",
        kind="instruction",
        name="rpdo1",
        joint="leg.hip",
        position_counts=at,
        registers=("controlword", "target_position"),
        hex=struct.pack("<Hi", word, counts).hex(),
    )


def drive_says(t: float, name: str, at: int) -> LogEntry:
    return LogEntry(t=t, bus="leg", kind="event", name=name, joint="leg.hip", position_counts=at)


def test_a_device_at_rest_before_it_has_read_its_next_goal_starts_once_for_that_goal() -> None:
    """Its log has the bytes as they came, and on a busy host the servo reads them some milliseconds later."""
    before = [begun(2, 2500), reported(3, 2310, 2300, STOP), reported(3.1, 2700, 2309), rest(3.102)]
    [one, two] = motions_of([*before, begun(3.104, 2700, 2310), rest(5)])["pan"]
    assert (one.stopped, one.rests) == (True, 3.1)
    assert (two.t, two.counts, two.at, two.rests) == (3.1, 2700, 2309, 5)
    again = motions_of([*before, begun(3.104, 2700, 2310), reported(4, 2700, 2500), rest(5)])["pan"]
    assert [motion.t for motion in again] == [2, 3.1, 4]
    again = motions_of([*before, reported(3.103, 2700, 2310), begun(3.104, 2700, 2310), rest(5)])["pan"]
    assert [motion.t for motion in again] == [2, 3.1, 3.104]
    again = motions_of([*before, begun(3.104, 2700, 2310), rest(5), begun(6, 2700, 2310)])["pan"]
    assert [motion.t for motion in again] == [2, 3.1, 6]  # once is enough
    there = structs.replace(rest(5), position_counts=2690)
    again = motions_of([*before[:3], there, begun(6, 2700, 2690)])["pan"]
    assert [motion.t for motion in again] == [2, 3.1, 6]  # it had carried out its command


def test_motions_of_a_drive_are_derived_from_its_commands_and_events() -> None:
    [one, two, three] = motions_of(
        [
            commanded(1, 0x3F, 452, 0),
            drive_says(1.01, "motion_started", 0),
            commanded(1.02, 0x2F, 452, 1),  # the end of the handshake
            commanded(2, 0x3F, -100, 242),
            commanded(3, 0x12F, 30, 40),  # halt
            drive_says(3.5, "at_rest", 20),
            commanded(4, 0x3F, 500, 20),
            drive_says(4.01, "motion_started", 20),
            commanded(5, 0x0B, 500, 300),  # quick stop
        ]
    )["leg.hip"]
    assert one == (1.01, 2500, 2048, 2, False, False)
    assert two == (2, 1948, 2290, 3.5, True, True)
    assert three == (4.01, 2548, 2068, math.inf, True, False)
    late = [
        *(commanded(1, 0x3F, 452, 0), drive_says(1.01, "motion_started", 0)),
        *(commanded(2, 0x12F, 452, 300), commanded(2.1, 0x3F, 800, 310)),
        *(drive_says(2.101, "at_rest", 310), drive_says(2.103, "motion_started", 310), drive_says(3, "at_rest", 800)),
    ]
    [one, two] = motions_of(late)["leg.hip"]
    assert one == (1.01, 2500, 2048, 2.1, True, False)
    assert two == (2.1, 2848, 2358, 3, False, True)


@pytest.mark.parametrize(
    ("faults", "found"),
    [
        ([], 1),
        ([Fault(t=9, what="strangers", whom="door", until=20)], 1),
        ([Fault(t=9, what="cut", whom="net1", until=10.5)], 0),
        ([Fault(t=11, what="freeze driver", whom="dora", until=20)], 0),
        ([Fault(t=1, what="kill driver", whom="dora", until=1e12)], 0),
        ([Fault(t=-20, what="kill driver", whom="dora", until=1e12)], 1),
    ],
)
def test_a_stop_that_does_not_get_through_is_found_unless_a_fault_explains_it(faults: list[Fault], found: int) -> None:
    missed = Rescue(t=10, whom="dora", until=12, through=False, said="no answer")
    assert len(judge([missed, *faults], {}).violations) == found
    assert judge([structs.replace(missed, through=True), *faults], {}).violations == []


@pytest.mark.parametrize(
    ("begins", "faults", "found"),
    [
        (3.0, [], 1),
        (3.0, [Fault(t=2, what="kill driver", whom="rosie", until=1e12)], 1),
        (3.0, [Fault(t=1.5, what="disk", whom="all", until=2.5)], 0),
        (1.9, [], 0),
        (4.1, [], 0),
    ],
)
def test_a_motion_that_begins_while_an_estop_is_open_is_found(begins: float, faults: list[Fault], found: int) -> None:
    alarm = Alarm(t=2, robot="rosie", since=1, until=4)
    order = structs.replace(ORDER, t=begins - 0.1)
    entries = {"rosie": [begun(begins, 2500), rest(begins + 1)]}
    verdict = judge([*HOLD, order, ANSWER, Done(t=9, hold="a:1", how="given back"), alarm, *faults], entries)
    assert [each for each in verdict.violations if "e-stop" in each] == verdict.violations
    assert len(verdict.violations) == found


@pytest.mark.parametrize("guilty", [{"cut"}, {"cut", "unplug"}, {"kill client", "delay", "disk"}])
def test_the_cause_of_a_failed_siege_is_found_by_leaving_faults_out(guilty: set[str]) -> None:
    assert set(fewest([*TROUBLES], lambda kinds: guilty <= {*kinds})) == guilty
