"""What one turn of each bus loop may cost, counted instead of timed: what is sent by it, and what it keeps.

The simulators' logs are the judge of what is sent, and the loop's own count of its turns is what it is divided by: so
however slow the machine is, the numbers are the same. What is said at other times than in a turn (a heartbeat, a value
that is asked for once a second) is in the tables, too, as once a turn at most.
"""

import gc
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.arm_rig import ArmRig
from tests.unit.drivers.conftest import Rig
from tests.unit.drivers.gripper_rig import HandRig
from tests.unit.drivers.legs import Leg
from tests.unit.drivers.motor_rig import DamiaoRig, OdriveRig
from tests.unit.drivers.tail_rig import TailRig
from trade_drivers import AttachedRobot
from trade_drivers.plugins._driver import Driver, drivers
from trade_hil_sim import LogEntry

pytestmark = pytest.mark.realtime

TURNS = 60
KEEPING_TURNS = 120
MOST_LOOKS = 12


@dataclass(frozen=True)
class Loop:
    """One kind of bus with two devices at rest (one, if it is a hand or an arm)."""

    make: Callable[[Path, ExitStack], Any]
    asked: dict[tuple[str, int], int]
    """What the driver sends in a turn at most: name (of CAN frames) and bytes, how often."""
    answered: dict[tuple[str, int], int]
    """What comes back for it; after a missing answer, a servo is asked for answers of another size for a while."""


_ASKED_IN_TURN = ("temperature", "bus_voltage_current", "error", "iq")
LOOPS = {
    "dynamixel": Loop(Rig, {("", 16): 1, ("", 14): 1}, {("sync_read", 21): 2, ("sync_read", 29): 2, ("read", 94): 1}),
    "feetech": Loop(
        TailRig,
        {("", 10): 1, ("", 8): 1},
        {**{("sync_read", size): 2 for size in (12, 14, 16)}, ("read", 33): 1},
    ),
    "cia402": Loop(
        lambda _, undo: Leg(undo), {("sync", 0): 1, ("heartbeat", 1): 1}, {("tpdo1", 8): 2, ("tpdo2", 7): 2}
    ),
    "odrive": Loop(
        lambda _, undo: OdriveRig(undo),
        {("ask_get_encoder_estimates", 0): 2} | {(f"ask_get_{name}", 0): 2 for name in _ASKED_IN_TURN},
        {(f"get_{name}", 8): 2 for name in _ASKED_IN_TURN},
    ),
    "damiao": Loop(lambda _, undo: DamiaoRig(undo), {("refresh", 8): 2}, {("feedback", 8): 2}),
    "robotiq": Loop(
        HandRig,
        {("", 8): 1},
        {("read_input", 11): 1, ("read", 11): 1, ("read_input", 7): 1, ("read", 9): 1},
    ),
    "ur": Loop(lambda _, undo: ArmRig(undo), {}, {}),
}
"""By driver."""
_BY_THEMSELVES = {("heartbeat", 1), ("heartbeat", 8), ("get_encoder_estimates", 8)}
"""What devices say unasked."""


@dataclass
class Running:
    loop: Loop
    rig: Any
    robot: AttachedRobot

    def measured(self, name: str) -> int:
        [value] = [one.value for one in self.robot.measures() if one.name == name]
        return int(value)

    @property
    def turns(self) -> int:
        return self.measured("bus_cycles")

    def turn(self, count: int) -> None:
        until = self.turns + count
        wait_until(lambda: self.turns >= until, f"{count} turns of the bus loop")


@pytest.fixture(params=LOOPS)
def running(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Running]:
    loop = LOOPS[request.param]
    with ExitStack() as undo:
        try:
            rig = loop.make(tmp_path, undo)
            if hasattr(rig, "plug"):
                rig.plug()
            robot = rig.attach()
        except ImportError as missing:
            pytest.skip(str(missing))
        made = Running(loop, rig, robot)
        made.turn(TURNS)
        yield made


def test_every_driver_of_a_bus_has_its_loop_here() -> None:
    ours = [point for points in drivers().values() for point in points if point.value.startswith("trade_drivers.")]
    assert {point.name for point in ours if issubclass(point.load(), Driver)} == set(LOOPS)


def test_a_bus_cycle_sends_a_bounded_number_of_bytes(running: Running) -> None:
    before, missed, seen = running.turns, running.measured("bus_missed_answers"), len(running.rig.log)
    running.turn(TURNS)
    new = running.rig.log[seen:]
    turns = (
        running.turns - before + 2 + running.measured("bus_missed_answers") - missed
    )  # who is not answered asks again
    asked = Counter((one.name, len(one.data)) for one in new if is_asked(one))
    answered = Counter((one.name, len(one.data)) for one in new if is_answer(one)) - Counter()
    for what, count in asked.items():
        assert count <= running.loop.asked.get(what, 0) * turns, f"{what}: {count} in {turns} turns, of {asked}"
    for what in set(answered) - _BY_THEMSELVES:
        assert answered[what] <= running.loop.answered.get(what, 0) * turns, f"{what}, of {answered} in {turns} turns"


def is_asked(one: LogEntry) -> bool:
    return one.kind == "received" or (one.kind == "frame" and one.direction == "in")


def is_answer(one: LogEntry) -> bool:
    return one.kind == "sent" or (one.kind == "frame" and one.direction == "out")


def test_bus_cycles_keep_no_memory(running: Running) -> None:
    """But for the last seconds, which faults are reported with: so it is looked at until that has grown no more.

    Of memory that the driver's own lines ask for: the simulator is in this process, too, and its log grows.
    """
    tracemalloc.start()
    try:
        grown: list[int] = []
        while not grown or grown[-1] >= KEEPING_TURNS / 2:
            assert len(grown) < MOST_LOOKS, f"something is kept of every turn, or of every second one: {grown}"
            before = kept()
            running.turn(KEEPING_TURNS)
            grown.append(kept() - before)
    finally:
        tracemalloc.stop()


def kept() -> int:
    """Blocks that lines of the drivers have asked for and that are still there."""
    gc.collect()
    ours = tracemalloc.Filter(inclusive=True, filename_pattern="*/trade_drivers/*")
    return sum(trace.count for trace in tracemalloc.take_snapshot().filter_traces([ours]).statistics("filename"))
