"""Dynamixel servos on a serial line."""

from collections.abc import Sequence
from typing import Any, ClassVar

import pytest

from tests.contract.rigs.joints import FIRST, SECOND, JointRig
from tests.support.simulated_robots import HEAD
from tests.unit.drivers.conftest import Rig, goal_counts
from trade_hil_sim import BadCrc, LogEntry, Mute, WrongModel, instructions, writes

_COUNTS_PER_RAD = 4096 / 6.283185307179586
_WATCHDOG_S = 0.3


class SerialJointRig(JointRig):
    """Servos that are written to only when there is something new."""

    says_on_waking: ClassVar = ("held up",)
    lost = (BadCrc(ids=(FIRST,), count=1), Mute(ids=(SECOND,), count=1, instruction="read"))

    def goal_of(self, entry: LogEntry) -> int:
        return goal_counts(entry)

    def commanded(self, since: float = 0.0) -> Sequence[LogEntry]:
        return self.bench.moves(since=since)

    def written(self) -> Sequence[LogEntry]:
        return writes(self.bench.log)

    def targets_rad(self, since: float) -> Sequence[float]:
        return [(self.goal_of(entry) - 2048) / self.counts_per_rad for entry in self.bench.goals(FIRST, since)]

    counts_per_rad: ClassVar[float]

    def counts(self, position_rad: float) -> int:
        return round(2048 + position_rad * self.counts_per_rad)

    def falls_silent(self) -> float:
        return float(self.bench.goals(FIRST)[-1].t) + 0.01

    def leaves(self, leave: str) -> None:
        driver = f'driver = "{self.vendor}"'
        self.configure((driver, f'{driver}\nleave = "{leave}"'))

    def judge_stop(self, asked: float) -> None:
        """No more than one exchange, the one under way, goes out before the stop."""
        written = next(
            entry for entry in self.bench.goals(FIRST, asked) if self.goal_of(entry) < self.counts(0.85 * self.max_rad)
        )
        assert len([e.name for e in instructions(self.bench.log, since=asked) if e.t < written.t]) <= 1


class DynamixelRig(SerialJointRig):
    """A head of two X-series servos."""

    column = "Dynamixel"
    bus, joint, group = "neck", "neck.pan", "head"
    max_rad, too_slow_rad_s = 1.4, 0.001
    vendor = "dynamixel"
    library, importing = ("dynamixel-sdk", "dynamixel_sdk"), ("vendors.dynamixel._wire",)
    counts_per_rad = _COUNTS_PER_RAD
    says_on_waking = ("held up for 1.", "watchdog")
    swapped = WrongModel(ids=(FIRST,), number=1020)
    says_model = "is 'XL430-W250', but id 1 is XM430-W350 (model number 1020)"
    says_absent = ('head.toml: joint."neck.tilt"', "id 2", "'neck'", "1000000 baud", "power")
    text = HEAD

    def on_the_bench(self) -> Any:
        return Rig(self.folder, self.undo)

    def last_resort(self, lost: float) -> None:
        """Register 98, the bus watchdog, stops the servo once it has heard nothing for its time."""
        expired = self.bench.wait_for("watchdog_expired", FIRST)
        assert self.bench.wait_for("at_rest", FIRST).t >= expired.t
        last_heard = max(entry.t for entry in instructions(self.bench.log) if entry.t <= expired.t)
        assert expired.t - last_heard == pytest.approx(_WATCHDOG_S, abs=0.05)

    def judge_ended(self) -> None:
        """A goal short of the one of the move was written before it rested."""
        began = self.bench.wait_for("motion_started", FIRST).t
        rest = self.bench.wait_for("at_rest", FIRST, began)
        held = [e for e in self.bench.goals(FIRST, began) if self.goal_of(e) < self.counts(1.25)]
        assert held[0].t <= rest.t

    def disarmed(self) -> bool:
        return bool(self.truth().watchdog == 0)

    def armed(self) -> bool:
        return [self.truth(one).watchdog for one in (1, 2)] == [15, 15]
