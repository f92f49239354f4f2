"""Joints on a CAN bus: CiA 402 drives, ODrives, Damiao motors."""

from collections.abc import Sequence
from typing import Any, ClassVar

from tests.contract.rigs.joints import FIRST, SECOND, JointRig
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.legs import COUNTS_PER_RAD, HALT, PATIENT, Leg
from tests.unit.drivers.motor_rig import KINDS, MotorRig
from trade_hil_sim import Entry


class Cia402Rig(JointRig):
    """A leg of two drives."""

    column = "CiA 402"
    bus, joint, group = "legs", "leg.hip", "leg"
    max_rad, too_slow_rad_s = 1.0, 0.0
    patience = (PATIENT,)

    def on_the_bench(self) -> Any:
        return Leg(self.undo)

    def states(self, since: float) -> list[str]:
        return [entry.detail for entry in self.events("state", since)]

    def commanded(self, since: float = 0.0) -> Sequence[object]:
        orders = {b"\x40\x60", b"\x60\x60", b"\x7a\x60", b"\xff\x60"}
        asked = self.bench.frames("sdo_request", since=since)
        written = [e for e in asked if e.data[0] & 0xE0 == 0x20 and e.data[1:3] in orders]
        return [*self.bench.frames("rpdo1", since=since), *written]

    def sent_away(self, since: float, within_rad: float = 0.0) -> Sequence[object]:
        return self.bench.goals(FIRST, since)

    def targets_rad(self, since: float) -> Sequence[float]:
        return [goal / COUNTS_PER_RAD for goal in self.bench.goals(FIRST, since)]

    def counts(self, position_rad: float) -> int:
        return round(position_rad * COUNTS_PER_RAD)

    def stopped_by_itself(self, since: float) -> float:
        wait_until(lambda: "quick_stop_active" in self.states(since), "the drive makes a quick stop")
        return float(self.bench.wait_for("at_rest", FIRST, since).t)

    def last_resort(self, lost: float) -> None:
        """Heartbeats end: the drive makes a quick stop, and keeps its torque."""
        moving = self.bench.wait_for("motion_started", FIRST)
        wait_until(lambda: "quick_stop_active" in self.states(moving.t), "the drive makes a quick stop")
        stopped = next(e for e in self.events("state", moving.t) if e.detail == "quick_stop_active")
        self.bench.wait_for("at_rest", FIRST, stopped.t)
        assert not self.bench.frames("rpdo1", FIRST, stopped.t)
        assert self._heartbeats()[-1].t < stopped.t
        assert self.states(stopped.t)[-1] == "quick_stop_active"

    def falls_silent(self) -> float:
        wait_until(lambda: self.bench.controlwords(FIRST)[-1] & HALT, "it was halted")
        wait_until(lambda: "quick_stop_active" in self.states(0.0), "the drive's own watchdog has its say")
        return written_now()

    def heard(self, since: float) -> Sequence[Entry]:
        return [entry for entry in self.bench.frames(since=since) if entry.direction == "in"]

    def _heartbeats(self) -> list[Entry]:
        return [entry for entry in self.bench.frames("heartbeat") if entry.can_id == 0x77F]

    def armed(self) -> bool:
        """The drive watches the heartbeat of the driver, and the driver gives one."""
        for joint in (FIRST, SECOND):
            writes = [e.data for e in self.bench.frames("sdo_request", joint)]
            assert bytes.fromhex("23161001") + (127 << 16 | 300).to_bytes(4, "little") in writes
            assert bytes.fromhex("2b076000 03000000") in writes
        count = len(self._heartbeats())
        wait_until(lambda: len(self._heartbeats()) >= count + 3, "the heartbeat goes on")
        return True

    def leaves(self, leave: str) -> None:
        self.configure(('channel = "can0"', f'channel = "can0"\nleave = "{leave}"'))

    def disarmed(self) -> bool:
        disarmed = [e for e in self.bench.frames("sdo_request", FIRST) if e.data == bytes.fromhex("2316100100000000")]
        return bool(disarmed)

    def judge_stop(self, asked: float) -> None:
        assert self.bench.controlwords(FIRST, asked)[-1] & HALT


class OdriveRig(JointRig):
    """A tail of two ODrives."""

    kind: ClassVar[str] = "odrive"
    column = "ODrive, Damiao"
    lacks: ClassVar = {
        "test_S06_every_enabled_joint_has_its_watchdog_armed": "the motor is configured to watch; unit/drivers/"
        "test_motor.py: an ODrive that does not is not enabled, and a Damiao is watched from attaching on",
        "test_S19_leaving_holds_the_position_disarms_the_watchdog_and_moves_nothing": "it can only relax: "
        "without its driver it lets go",
    }
    bus, joint, group = "tail", "tail.root", "tail"
    max_rad, too_slow_rad_s = 1.0, 0.0
    patience = (("watchdog_s = 0.4", "watchdog_s = 0.5"),)
    bench: MotorRig

    def on_the_bench(self) -> Any:
        return KINDS[self.kind](self.undo)

    def commanded(self, since: float = 0.0) -> Sequence[object]:
        return self.bench.commanded(FIRST, since)

    def targets_rad(self, since: float) -> Sequence[float]:
        gear = self.bench.robot.joints[0].gear
        return [target / gear for target in self.bench.targets(FIRST, since)]

    def counts(self, position_rad: float) -> int:
        return round(1000 * position_rad * self.bench.robot.joints[0].gear / self.bench.unit_rad)

    def last_resort(self, lost: float) -> None:
        """The motor lets go, and coasts."""
        moving = self.bench.wait_for("motion_started", FIRST)
        expired = self.bench.wait_for("watchdog_expired", FIRST, moving.t)
        self.bench.wait_for("torque_off", FIRST, moving.t)
        wait_until(lambda: not self.moving, "it is at rest")
        assert not self.bench.commanded(FIRST, expired.t)

    def falls_silent(self) -> float:
        self.bench.wait_for("watchdog_expired", FIRST)
        return written_now()

    def heard(self, since: float) -> Sequence[Entry]:
        return [entry for entry in self.bench.frames(since=since) if entry.direction == "in"]

    def leaves(self, leave: str) -> None:
        assert leave == "relax", "as its robot file says"


class DamiaoRig(OdriveRig):
    """A tail of two Damiao motors."""

    kind = "damiao"
