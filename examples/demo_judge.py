"""Compares what the behaviours print with the log of the simulated devices."""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import greet
import msgspec
import walk
from demo_actor import PATIENCE_S, DemoFailed
from demo_stage import ROBOT

import trade_drivers
from trade_hil_sim import LogEntry, SimControl, events, frames, motion_writes, read_log

AGREE_RAD = 0.02
"""A servo's own dead band is about a tenth of this."""
PAN = "neck.pan"

_LINES = msgspec.json.Decoder(LogEntry)
_T = TypeVar("_T")


class Judge:
    """Reads the simulator's log of one run; whatever disagrees raises DemoFailed."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._robot = trade_drivers.load(ROBOT)
        self._read = 0
        """Bytes of the log from which the events have been taken."""
        self._events: list[LogEntry] = []

    def rests(self, joint: str, since: float) -> list[LogEntry]:
        """Each time a joint came to rest."""
        return [entry for entry in events(self._so_far(), "at_rest", since=since) if entry.joint == joint]

    def moves(self, joint: str, since: float) -> list[LogEntry]:
        """Each time it began to move."""
        return [entry for entry in events(self._so_far(), "motion_started", since=since) if entry.joint == joint]

    def moving(self, joint: str) -> bool:
        """Whether the last that it did was to begin to move."""
        own = [entry.name for entry in self._so_far() if entry.joint == joint]
        return next((name for name in reversed(own) if name in {"motion_started", "at_rest"}), "") == "motion_started"

    def _so_far(self) -> list[LogEntry]:
        """All events; only what is new is read, since a bus of drives writes thousands of lines a second."""
        with self._log.open("rb") as log:
            log.seek(self._read)
            whole, end, _ = log.read().rpartition(b"\n")
        self._read += len(whole) + len(end)
        self._events += events(_LINES.decode_lines(whole))
        return self._events

    def wait_for(self, what: Callable[[], _T]) -> _T:
        """What the log shows, once it does."""
        until = time.monotonic() + PATIENCE_S
        while not (found := what()):
            if time.monotonic() > until:
                raise DemoFailed("the simulator's log does not show what should have happened")
            time.sleep(0.05)
        return found

    def looked(self, looks_rad: Sequence[float], since: float) -> None:
        """The pan servo came to rest there, one after the other, and nothing was sent for the refused command."""
        rests = self.rests(PAN, since)
        say("of what the pan servo itself did:")
        for entry in rests:
            angle_rad, counts = entry.position_rad or 0.0, entry.position_counts
            print(f"    {entry.t - since:6.2f} s  at rest at {angle_rad:+.3f} rad ({counts} counts)")
        angles = [entry.position_rad or 0.0 for entry in rests]
        if len(angles) != len(looks_rad) or any(not _near(*pair) for pair in zip(angles, looks_rad, strict=True)):
            raise DemoFailed(f"the servo should have come to rest at {looks_rad}, but was at {angles}")
        late = motion_writes(read_log(self._log), since=rests[-1].t, bus="neck")
        print(f"    after that {len(late)} writes that could move it: the refused command was never sent")
        if late:
            raise DemoFailed("the refused command reached the wire")

    def walked(self, began_s: float, stood_s: float) -> None:
        """Checks three steps: only the owner of the legs moved them, and the head moved at the same time."""
        standing_rad = walk.STAND[0]
        ends = [walk.FORWARD[0] if leg == "left" else walk.BACK[0] for leg in walk.STEPS]
        expected = {"legs.left.hip": [*ends, standing_rad], "legs.right.hip": [*(-end for end in ends), standing_rad]}
        say("of the drives and the servos:")
        for joint, through in expected.items():
            angles = [entry.position_rad or 0.0 for entry in self.rests(joint, began_s)]
            if not _in_order(through, angles):
                raise DemoFailed(f"{joint} should have come to rest at {through}, but was at {angles}")
            print(f"    {joint:<15} came to rest at {', '.join(f'{angle:+.2f}' for angle in through)} rad")
        highest = max(self._knee_targets(began_s))
        print(f"    legs.left.knee  was commanded to {highest:.2f} rad at most; the kick wanted {walk.KICK_RAD:.2f}")
        if not _near(highest, walk.LIFTED[1]):
            raise DemoFailed("another client's goal is among those of the walk, or goals of the walk are missing")
        if late := motion_writes(read_log(self._log), since=stood_s, bus="legs"):
            raise DemoFailed(f"the legs received {len(late)} commands after the walk had ended")
        meanwhile = [entry for entry in self.rests(PAN, began_s) if entry.t < stood_s]
        print(f"    neck.pan        came to rest {len(meanwhile)} times meanwhile: the head's lock is another one")
        if not meanwhile:
            raise DemoFailed("the head did not look around during the walk")

    def greeted(self, began_s: float, control: SimControl, *, with_left: bool) -> None:
        """The tail wagged, the right arm rose and sank, and the left arm left its pose and came back to it."""
        say("of three other wires:")
        lift = greet.RAISED[1]
        expected = {
            "tail.root": [wag[0] for wag in greet.WAGS],
            "right.shoulder.lift": [lift, greet.LOWERED[1]],
        }
        for joint, through in expected.items():
            angles = [entry.position_rad or 0.0 for entry in self.rests(joint, began_s)]
            if not _in_order(through, angles):
                raise DemoFailed(f"{joint} should have come to rest at {through}, but was at {angles}")
            print(f"    {joint:<19} came to rest at {', '.join(f'{angle:+.2f}' for angle in through)} rad")
        if not with_left:
            return
        [arm] = self._robot.arms
        bases = [msgspec.json.decode(entry.detail, type=list[float])[0] for entry in self.rests(arm.name, began_s)]
        through = [arm.poses[name][0] for name in ("wave", "home")]
        if not _in_order(through, bases):
            raise DemoFailed(f"the left arm should have gone {through}, but was at {bases}")
        truth = control.arm(arm.name)
        print(f"    {arm.name:<19} base at {', '.join(f'{angle:+.2f}' for angle in through)} rad; {truth.robot_mode}")

    def _knee_targets(self, since: float) -> list[float]:
        """The angles of all frames that command the left knee."""
        joint = next(joint for joint in self._robot.joints if joint.name == "legs.left.knee")
        assert joint.counts_per_rev
        rad_per_count = math.tau / (joint.counts_per_rev * joint.gear)
        log = read_log(self._log)
        targets = [
            *(frame.data[2:6] for frame in frames(log, "rpdo1", device_id=joint.id, since=since, bus="legs")),
            *(frame.data for frame in frames(log, "rpdo4", device_id=joint.id, since=since, bus="legs")),
        ]
        return [int.from_bytes(target, "little", signed=True) * rad_per_count for target in targets]


def say(what: str) -> None:
    print(f"  the simulator's log, {what}")


def _near(angle: float, expected: float) -> bool:
    return abs(angle - expected) <= AGREE_RAD


def _in_order(expected: Sequence[float], angles: Sequence[float]) -> bool:
    """Whether these are among the angles, in this order, and the last of them is the last."""
    left = iter(angles)
    return all(any(_near(angle, each) for angle in left) for each in expected) and _near(angles[-1], expected[-1])
