"""Feetech servos on a serial line."""

from typing import Any, ClassVar

from tests.contract.rigs.dynamixel import SerialJointRig
from tests.contract.rigs.joints import FIRST, SECOND
from tests.support.simulated_robots import TAIL
from tests.unit.drivers.tail_rig import COUNTS_PER_RAD, TailRig, goal_of, lead_counts, measured_before
from trade_hil_sim import LogEntry, WrongModel


class FeetechRig(SerialJointRig):
    """A tail of two servos that have no watchdog: no goal is far ahead of where the joint is."""

    column = "Feetech"
    lacks: ClassVar = {
        "test_S06_every_enabled_joint_has_its_watchdog_armed": "the servo has no watchdog",
    }
    bus, joint, group = "tail", "tail.root", "tail"
    max_rad, too_slow_rad_s = 1.4, 0.01
    vendor = "feetech"
    library = "pyserial", "serial"
    importing = ("vendors.feetech._wire", "joints.serial._wire", "bus._serial_port")
    counts_per_rad = COUNTS_PER_RAD
    text = TAIL
    swapped = WrongModel(ids=(SECOND,), number=1285)
    says_model = "'STS3215', but id 2 is a model this driver does not know (model number 1285)"
    says_absent = (
        'joint."tail.tip": no device answers to id 2',
        "its id (register 5) and its baud rate (register 6)",
    )
    patience = (('driver = "feetech"', 'driver = "feetech"\nstale_after_s = 1'),)  # a busy machine is no silence

    def on_the_bench(self) -> Any:
        return TailRig(self.folder, self.undo)

    def goal_of(self, entry: LogEntry) -> int:
        return goal_of(entry)

    def judge_ended(self) -> None:
        self.bench.wait_for("at_rest", FIRST)
        assert all(goal_of(entry) < self.counts(1.2) for entry in self.bench.goals(FIRST))

    def stopped_by_itself(self, since: float) -> float:
        return float(self.bench.wait_for("at_rest", FIRST, since).t)

    def last_resort(self, lost: float) -> None:
        """The servo ends at the goal that it was sent last, and that goal is near."""
        self.bench.wait_for("at_rest", FIRST)
        log, last = self.bench.log, self.bench.goals(FIRST)[-1]
        assert self.truth().position_counts == goal_of(last)
        assert goal_of(last) - measured_before(log, last) <= lead_counts(0.1)
