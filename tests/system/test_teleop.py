"""Two arms, one moved by hand: what the other one's simulator saw of following, of its limits, and of the end."""

import math
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import pytest

import trade
from tests.support.simulated_robots import at_rest
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import ROOT, Bench, Program
from trade import where
from trade_hil_sim import LogEntry, events, motion_writes

TELEOP = ROOT / "examples" / "teleop.py"
ROBOT = ROOT / "examples" / "teleop.toml"
JOINTS = range(1, 7)
FOLLOWER_RAD_S = 1.5
"""The limit of each of its joints, by the robot file."""
SLOWLY_RAD_S = 0.3
RAD = math.tau / 4096
CENTRE = 2048
JAW_RAD = -0.1
"""The least angle of the last joint."""
TOLERANCE_RAD = 0.08


class Seen(NamedTuple):
    """What a servo said when it was asked where it is."""

    t: float
    position_rad: float
    speed_rad_s: float


def said(entries: Iterable[LogEntry], device_id: int, since: float = 0.0) -> list[Seen]:
    """All that a joint of the follower reported, which is the truth in a simulator: registers 56 to 61."""
    return [
        Seen(entry.t, (int.from_bytes(entry.data[5:7], "little") - CENTRE) * RAD, signed(entry.data[7:9]) * RAD)
        for entry in entries
        if (entry.bus, entry.kind, entry.name) == ("follower", "sent", "sync_read")
        and entry.device_id == device_id
        and entry.t >= since
    ]


def signed(data: bytes) -> int:
    """Sign and magnitude, as the servo writes speeds."""
    number = int.from_bytes(data, "little")
    return -(number & 0x7FFF) if number & 0x8000 else number


def goal_speeds(entries: Iterable[LogEntry], since: float = 0.0) -> list[float]:
    """In rad/s, of all goals that were written to the follower: the last of acceleration, goal, time and speed."""
    goals = [entry for entry in motion_writes(entries, since=since, bus="follower") if entry.address == 41]
    return [int.from_bytes(entry.data[5:7], "little") * RAD for entry in goals]


def travelled(places: Sequence[float]) -> float:
    return sum(abs(after - before) for before, after in pairwise(places))


class Pair:
    """Both arms up, and the example running."""

    def __init__(self, bench: Bench, run: Callable[..., Program]) -> None:
        self.sim = bench.sim
        self._run = run

    def place(self, joint: int, position_rad: float) -> None:
        self.sim.control.place(round(CENTRE + position_rad / RAD), [joint], bus="leader")

    def teleop(self) -> Program:
        return self._run(TELEOP)

    def hand(self) -> Program:
        return self._run(TELEOP, "hand", str(self.sim.control_path))

    def position_rad(self, joint: str) -> float:
        return self.sim.control.device(joint).position_rad

    def rests_at(self, joint: str, position_rad: float) -> bool:
        return abs(self.position_rad(joint) - position_rad) < TOLERANCE_RAD and self.at_rest()

    def at_rest(self) -> bool:
        return all(at_rest(device) for bus in self.sim.control.state() for device in bus.devices)


@pytest.fixture
def pair(benches: Callable[..., Bench], run: Callable[..., Program]) -> Pair:
    return Pair(benches(ROBOT), run)


def wait_while_up(program: Program, true: Callable[[], object]) -> None:
    wait_until(lambda: program.process.poll() is not None or true())
    assert program.process.poll() is None, "".join(program.errors)


def wait_for(program: Program, text: str) -> None:
    while text not in program.line():
        pass


def test_the_follower_goes_to_the_leader_slowly_then_where_it_goes_and_no_quicker_than_it_may(pair: Pair) -> None:
    pair.place(1, 0.4)
    program = pair.teleop()
    assert "pair.follower.shoulder.pan is +0.40 rad away from the leader; going there at 0.3 rad/s" in program.line()
    wait_for(program, "following")
    entries = pair.sim.entries()
    arrived = next(one.t for one in events(entries, "at_rest", device_id=1) if one.bus == "follower")
    approach = [seen.speed_rad_s for seen in said(entries, 1) if seen.t <= arrived]
    assert 0.8 * SLOWLY_RAD_S < max(approach) <= SLOWLY_RAD_S + RAD
    pair.place(1, 0.0)
    wait_while_up(program, lambda: pair.rests_at("follower.shoulder.pan", 0.0))

    began = time.monotonic()
    assert pair.hand().wait() == 0
    wait_while_up(program, pair.at_rest)
    entries = pair.sim.entries()
    for joint in JOINTS:
        led = [place.position_rad or 0.0 for place in events(entries, "placed", device_id=joint, since=began)]
        went = [seen.position_rad for seen in said(entries, joint, began)]
        assert len(led) > 100
        assert max(went) == pytest.approx(max(led), abs=TOLERANCE_RAD)
        assert min(went) == pytest.approx(min(led), abs=TOLERANCE_RAD)
        assert travelled(went) == pytest.approx(travelled(led), rel=0.2)

    began = time.monotonic()
    pair.place(5, 1.5)  # all at once: quicker than the follower may
    wait_while_up(program, lambda: pair.rests_at("follower.wrist.roll", 1.5))
    entries = pair.sim.entries()
    quickest = max(abs(seen.speed_rad_s) for seen in said(entries, 5, began))
    assert quickest > 0.8 * FOLLOWER_RAD_S
    assert max(abs(seen.speed_rad_s) for joint in JOINTS for seen in said(entries, joint)) <= FOLLOWER_RAD_S + RAD
    assert max(goal_speeds(entries)) <= FOLLOWER_RAD_S + RAD

    pair.place(6, JAW_RAD - 0.5)  # beyond the follower's range
    wait_while_up(program, lambda: pair.rests_at("follower.jaw", JAW_RAD))
    assert min(seen.position_rad for seen in said(pair.sim.entries(), 6)) >= JAW_RAD - RAD


def following(pair: Pair) -> Program:
    """The follower is on its way, led by the hand."""
    program = pair.teleop()
    wait_for(program, "following")
    pair.hand()
    wait_while_up(program, lambda: pair.position_rad("follower.shoulder.pan") > 0.2)
    return program


def ended(program: Program) -> tuple[int, str, str]:
    lines = program.lines()
    return program.wait(), "".join(lines), "".join(program.errors)


def test_it_stops_when_the_leader_is_unplugged_though_the_hand_moves_on(pair: Pair) -> None:
    program = following(pair)
    pair.sim.control.unplug("leader")
    code, lines, errors = ended(program)
    over = time.monotonic()
    assert code == 1
    assert "the follower holds" in lines
    assert "pair.leader.shoulder.pan" in errors
    place = pair.position_rad("follower.shoulder.pan")
    wait_until(lambda: events(pair.sim.entries(), "placed", device_id=1, since=over + 0.5))
    assert pair.position_rad("follower.shoulder.pan") == place
    assert pair.at_rest()
    assert motion_writes(pair.sim.entries(), since=over, bus="follower") == []


def test_ctrl_c_ends_it_and_the_follower_holds(pair: Pair) -> None:
    program = following(pair)
    program.signal(signal.SIGINT)
    assert ended(program) == (0, "teleop: the follower holds\nteleop: ended\n", "")
    assert pair.at_rest()
    assert pair.sim.control.device("follower.shoulder.pan").torque


def test_a_follower_whose_lock_is_broken_halts_and_obeys_other_clients(pair: Pair) -> None:
    program = following(pair)
    trade.find(where(name="move_to", group="pair.follower", kind="JointGroup"), wait_s=PATIENCE_S)
    trade.break_lock(where(group="pair.follower"), reason="a person is in the way")
    code, _, errors = ended(program)
    assert code == 1
    assert "LockLost" in errors or "MotionStopped" in errors  # whichever comes first
    move: Any = trade.find(where(name="move_to", group="pair.follower", kind="JointGroup"))
    with trade.lock(where(group="pair.follower"), wait_s=PATIENCE_S):  # granted once it is at rest
        assert pair.at_rest()
        assert move([0.1] * 6)[0] == pytest.approx(0.1, abs=TOLERANCE_RAD)


def test_a_leader_that_holds_is_refused_and_nothing_moves(pair: Pair) -> None:
    trade.find(where(name="enable", group="pair.leader", kind="JointGroup"), wait_s=PATIENCE_S)()
    trade.close()  # what it enabled stays enabled
    code, _, errors = ended(pair.teleop())
    assert code == 1
    assert "pair.leader.shoulder.pan" in errors and "cannot be moved by hand" in errors
    assert motion_writes(pair.sim.entries(), bus="follower") == []
