"""Joints on a CAN bus: CiA 402 drives, ODrives, Damiao motors."""

from collections.abc import Sequence
from typing import Any, ClassVar

import pytest

from tests.contract.rigs.base import answers
from tests.contract.rigs.joints import FIRST, SECOND, JointRig
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.legs import COUNTS_PER_RAD, HALT, PATIENT, Leg
from tests.unit.drivers.motor_rig import KINDS, MotorRig
from trade.errors import DeviceFault
from trade_drivers import parse
from trade_hil_sim import Late, LogEntry, Mute, WrongModel

_NO_PORT = "unit/drivers/test_never_twice.py has two drivers of a bus"
_QUICK_STOP = 0x02
"""Of bits 1, 2 and 7 of the controlword only the first (CiA 402-2, device control commands)."""


class CanJointRig(JointRig):
    """Joints that are asked for their state all the time."""

    max_rad, too_slow_rad_s = 1.0, 0.0
    says_on_return: ClassVar[str | None] = None

    def attach_to_ask(self) -> None:
        """With the port in the file, as the angles of another one are not saved."""
        name = self.bench.sim.port.partition(":")[2]
        self.bench.text = self.bench.text.replace('"socketcan"\nchannel = "can0"', f'"socketcand"\nchannel = "{name}"')
        self.bench.robot = parse(self.bench.text, "robot.toml")
        self.attach(ports={}, state_dir=self.folder)

    def judge_return(self) -> None:
        wait_until(lambda: answers(self.robot.motor(self.second).state), "the other joint is back")
        back = self.device.state().measured_at
        wait_until(lambda: self.device.state().measured_at > back + 0.3, "it had time")
        with pytest.raises(DeviceFault, match=self.says_on_return):
            self.device.move_to(0.0)
        assert not self.bench.events("motion_started", SECOND)
        assert "operation_enabled" not in [entry.detail for entry in self.bench.events("state", SECOND)]

    def heard(self, since: float) -> Sequence[LogEntry]:
        return [entry for entry in self.bench.frames(since=since) if entry.direction == "in"]


class Cia402Rig(CanJointRig):
    """A leg of two drives."""

    vendor, column = "cia402", "CiA 402"
    library = "canopen", "canopen"
    importing = tuple(f"vendors.cia402.{name}" for name in ("_exchange", "_verify", "_wire"))
    bus, joint, group = "legs", "leg.hip", "leg"
    within_rad, exactly_rad = 0.01, 1e-5
    patience = (PATIENT,)
    others = (("home",),)
    says_on_return = "it was away"
    says_model = "joint.\"leg.hip\".model: is 'ACME-EC45', but node 1 says it is 'ACME-EC60' (1008h)"
    lost = (Mute(ids=(FIRST,), instruction="sdo_reply", count=2),)
    says_absent = ('leg.toml: joint."leg.knee"', "node 2", "power", "bit rate", "terminations")
    lacks: ClassVar = {"test_S20_a_second_driver_on_the_port_is_refused_and_sends_not_one_byte": _NO_PORT}

    def on_the_bench(self) -> Any:
        return Leg(self.undo)

    def swap(self) -> None:
        self.plug()
        self.configure(("ACME-EC60", "ACME-EC45"))

    def states(self, since: float) -> list[str]:
        return [entry.detail for entry in self.events("state", since)]

    def commanded(self, since: float = 0.0) -> Sequence[object]:
        orders = {b"\x40\x60", b"\x60\x60", b"\x7a\x60", b"\xff\x60"}
        asked = self.bench.frames("sdo_request", since=since)
        written = [e for e in asked if e.data[0] & 0xE0 == 0x20 and e.data[1:3] in orders]
        return [*self.bench.frames("rpdo1", since=since), *written]

    def written(self) -> Sequence[object]:
        """Also commands of network management, except starting one drive."""
        starts = (bytes((1, FIRST)), bytes((1, SECOND)))
        return [*self.commanded(), *(entry for entry in self.bench.frames("nmt") if entry.data not in starts)]

    def sent_away(self, since: float, within_rad: float = 0.0) -> Sequence[object]:
        return self.bench.goals(FIRST, since)

    def targets_rad(self, since: float) -> Sequence[float]:
        frames = self.bench.frames("rpdo1", FIRST, since)
        return [int.from_bytes(e.data[2:], "little", signed=True) / COUNTS_PER_RAD for e in frames]

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
        expired = self.bench.wait_for("watchdog_expired", FIRST)
        wait_until(lambda: len(self.bench.frames("heartbeat", FIRST, expired.t)) > 3, "the drive continues")
        return self._halted()

    def _halted(self) -> float:
        """When it was at rest, which a halt, or a quick stop in modes without one, has brought it to."""
        began = self.bench.wait_for("motion_started", FIRST).t
        rest = self.bench.wait_for("at_rest", FIRST, began)
        sent = [e for e in self.bench.frames("rpdo1", FIRST, began) if e.t <= rest.t]
        words = [int.from_bytes(e.data[:2], "little") for e in sent]
        assert any(word & HALT or word & 0x86 == _QUICK_STOP for word in words)
        return float(rest.t)

    def judge_ended(self) -> None:
        self._halted()
        assert self.truth().position_rad < 0.8

    def _heartbeats(self) -> list[LogEntry]:
        return [entry for entry in self.bench.frames("heartbeat") if entry.can_id == 0x77F]

    def armed(self) -> bool:
        """The drive watches the heartbeat of the driver, and the driver gives one."""
        for joint in (FIRST, SECOND):
            writes = [e.data for e in self.bench.frames("sdo_request", joint)]
            assert bytes.fromhex("23161001") + (127 << 16 | 300).to_bytes(4, "little") in writes
            assert bytes.fromhex("2b076000 03000000") in writes
        count = len(self._heartbeats())
        wait_until(lambda: len(self._heartbeats()) >= count + 3, "the heartbeat continues")
        return True

    def leaves(self, leave: str) -> None:
        self.configure(('channel = "can0"', f'channel = "can0"\nleave = "{leave}"'))

    def disarmed(self) -> bool:
        disarmed = [e for e in self.bench.frames("sdo_request", FIRST) if e.data == bytes.fromhex("2316100100000000")]
        return bool(disarmed)

    def judge_stop(self, asked: float) -> None:
        assert self.bench.controlwords(FIRST, asked)[-1] & HALT


class OdriveRig(CanJointRig):
    """A tail of two ODrives."""

    vendor = "odrive"
    library, importing = ("python-can", "can"), ("bus.can", "bus.can._port")
    column = "ODrive, Damiao"
    lacks: ClassVar = {
        "test_S06_every_enabled_joint_has_its_watchdog_armed": "the motor is configured to watch; unit/drivers/"
        "test_motor.py: an ODrive that does not is not enabled, and a Damiao is watched from attaching on",
        "test_S19_shutdown_holds_the_position_disarms_the_watchdog_and_moves_nothing": "it can only relax: "
        "without its driver it lets go",
        "test_S20_a_second_driver_on_the_port_is_refused_and_sends_not_one_byte": _NO_PORT,
    }
    bus, joint, group = "tail", "tail.root", "tail"
    patience = (("watchdog_s = 0.4", "watchdog_s = 0.5"),)
    swapped, says_model = WrongModel(ids=(SECOND,), number=4), "product line 4"
    says_absent = ('tail.toml: joint."tail.tip": no motor answers as 2',)
    bench: MotorRig

    def on_the_bench(self) -> Any:
        return KINDS[self.vendor](self.undo)

    def commanded(self, since: float = 0.0) -> Sequence[object]:
        return self.bench.commanded(FIRST, since)

    def written(self) -> Sequence[object]:
        return self.bench.commanded()

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

    def leaves(self, leave: str) -> None:
        assert leave == "relax", "as its robot file says"


class DamiaoRig(OdriveRig):
    """A tail of two Damiao motors."""

    vendor = "damiao"
    says_model = "velocity of a DM4340 goes to 10, but motor 1 is set to 30"

    def swap(self) -> None:
        self.plug()
        self.configure(('model = "DM4310"', 'model = "DM4340"'))

    def stopped_by_itself(self, since: float) -> float:
        """From then on it answers late, as to a busy computer: no hold may precede its answer."""
        stopped = super().stopped_by_itself(since)
        self.bench.sim.do(Late(ids=(FIRST, SECOND), s=0.03))
        return stopped

    def sent_on_waking(self, since: float) -> Sequence[object]:
        """No set-point, not even one that leads nowhere: the motor gets one in each cycle of a motion."""
        return self.targets_rad(since)

    def ordered(self, since: float) -> Sequence[object]:
        """Every cycle sends an enabled motor to where it is."""
        orders = [entry for entry in self.bench.commanded(FIRST, since) if entry.name != self.bench.target]
        return [*orders, *self.sent_away(since)]
