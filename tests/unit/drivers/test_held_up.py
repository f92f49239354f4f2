"""A driver that was held up for longer than its watchdog resumes no motion; what the devices were sent decides.

Its process was frozen, or the whole host was suspended: the joints have stopped by themselves meanwhile.
"""

import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from math import tau
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.drivers.conftest import Outcome, Rig, goal_counts, sleep_past, written_now
from tests.unit.drivers.legs import COUNTS_PER_RAD as DRIVE_COUNTS
from tests.unit.drivers.legs import GO, HIP, Leg
from tests.unit.drivers.motor_rig import KINDS, ROOT
from tests.unit.drivers.tail_rig import COUNTS_PER_RAD as TAIL_COUNTS
from tests.unit.drivers.tail_rig import TailRig, goal_of
from trade.errors import DeviceFault, MotionStopped
from trade_drivers import JointGroup, Motor, Tolerances, Trajectory, TrajectoryPoint
from trade_drivers.joints import AwaitedJob, Steps

pytestmark = pytest.mark.virtual_time

SPEED_RAD_S = 0.5
WATCHDOG_S = 0.4
AWAY_S = 1.4
_PATIENT = f"watchdog_s = {WATCHDOG_S}\nstale_after_s = 0.4"
MOST_RAD = SPEED_RAD_S * WATCHDOG_S + 0.06
"""As far as a joint gets until its watchdog stops it, and while it brakes; at its speed it would get 0.7 rad."""


class _HoldUp(AwaitedJob[Any]):
    """Work in the middle of a cycle, after its measurements, that does not come back until it is let go."""

    def __init__(self, motor: Any) -> None:
        super().__init__(motor._axes)
        self.exchange = motor._exchange
        self.reached, self.go = threading.Event(), threading.Event()

    def steps(self) -> Steps:
        self.reached.set()
        self.go.wait(PATIENCE_S)
        yield


class Joint:
    """The first joint of a robot with two of a kind, and where it was sent, in rad."""

    def __init__(self, rig: Any, names: tuple[str, str], device_id: int, sent: Callable[[Any, float], list[float]]):
        self._rig, self._id, self._sent = rig, device_id, sent
        self.rests_rad = self.woke = 0.0
        robot = rig.attach()
        self.motor: Motor = robot.motor(names[0])
        self.group: JointGroup = robot.group(names[1])
        self.group.enable()

    @property
    def rad(self) -> float:
        return float(self._rig.truth(self._id).position_rad)

    @property
    def moving(self) -> bool:
        return bool(self._rig.truth(self._id).moving)

    def sent(self, since: float) -> list[float]:
        return self._sent(self._rig, since)

    def move(self) -> object:
        return self.motor.move_to(0.95, SPEED_RAD_S)

    def follow(self) -> object:
        here = [state.position_rad for state in self.group.state()]
        points = [
            TrajectoryPoint(time_from_start_s=at_s, positions_rad=[here[0] + at_s * SPEED_RAD_S, here[1]])
            for at_s in (0.0, 1.8)
        ]
        return self.group.follow(Trajectory(joints=self.group.joints(), points=points), Tolerances(path_rad=1.0))

    def turn(self) -> object:
        return self.motor.set_velocity(SPEED_RAD_S, 1.0)

    def set_off(self, act: Callable[[], object]) -> Outcome:
        moving = Outcome(act)
        wait_until(lambda: moving.error or self.rad > 0.1, "it is under way")
        assert moving.error is None
        return moving

    def woke_up(self) -> None:
        """Whatever is sent from now on counts; how far it is from where the joint is now."""
        self.rests_rad, self.woke = self.rad, written_now()

    @contextmanager
    def held_up(self) -> Iterator[None]:
        """Within it the bus thread is in the middle of a cycle, for longer than the watchdog lets joints go on."""
        job = _HoldUp(self.motor)
        job.exchange.submit(job)
        assert job.reached.wait(PATIENCE_S)
        over_ns = time.monotonic_ns() + int(AWAY_S * 1e9)
        try:
            yield
            wait_until(lambda: not self.moving, "it has stopped by itself")
            sleep_past(over_ns)
            self.woke_up()
        finally:
            job.go.set()


def _servo(tmp_path: Path, undo: ExitStack) -> Joint:
    rig = Rig(tmp_path, undo)
    rig.configure(('driver = "dynamixel"', f'driver = "dynamixel"\n{_PATIENT}'))
    rig.plug()
    return Joint(
        rig,
        ("neck.pan", "head"),
        1,
        lambda rig, since: [(goal_counts(entry) - 2048) * tau / 4096 for entry in rig.goals(1, since)],
    )


def _tail_servo(tmp_path: Path, undo: ExitStack) -> Joint:
    rig = TailRig(tmp_path, undo)
    rig.configure(('driver = "feetech"', f'driver = "feetech"\n{_PATIENT}'))
    rig.plug()
    return Joint(
        rig,
        ("tail.root", "tail"),
        1,
        lambda rig, since: [(goal_of(entry) - 2048) / TAIL_COUNTS for entry in rig.goals(1, since)],
    )


def _drive(_: Path, undo: ExitStack) -> Joint:
    rig = Leg(undo)
    rig.configure(('channel = "can0"', f'channel = "can0"\n{_PATIENT}'))
    rig.plug()
    return Joint(rig, ("leg.hip", "leg"), HIP, _sent_to_drive)


def _sent_to_drive(leg: Leg, since: float) -> list[float]:
    raised = [struct.unpack("<Hi", e.data[:6]) for e in leg.frames("rpdo1", HIP, since)]
    positions = [position for word, position in raised if word & GO]
    positions += [struct.unpack("<i", e.data[:4])[0] for e in leg.frames("rpdo4", HIP, since)]
    return [position / DRIVE_COUNTS for position in positions]


def _motor(kind: str) -> Callable[[Path, ExitStack], Joint]:
    def make(_: Path, undo: ExitStack) -> Joint:
        rig = KINDS[kind](undo)
        rig.plug()
        gear = rig.robot.joints[0].gear
        return Joint(
            rig, ("tail.root", "tail"), ROOT, lambda rig, since: [rad / gear for rad in rig.targets(ROOT, since)]
        )

    return make


MAKERS = {
    "dynamixel": _servo,
    "feetech": _tail_servo,
    "cia402": _drive,
    "odrive": _motor("odrive"),
    "damiao": _motor("damiao"),
}


@pytest.fixture(params=list(MAKERS))
def joint(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Joint]:
    with ExitStack() as undo:
        yield MAKERS[request.param](tmp_path, undo)


def assert_nothing_sends_it_away(joint: Joint) -> None:
    """Half a second later, nothing has been sent that is farther than the joint got by itself."""
    sleep_past(int((joint.woke + 0.5) * 1e9))
    assert [rad for rad in joint.sent(joint.woke) if abs(rad - joint.rests_rad) > MOST_RAD] == []
    assert abs(joint.rad - joint.rests_rad) < MOST_RAD


@pytest.mark.parametrize("act", [Joint.move, Joint.follow])
def test_S06_held_up_in_a_cycle_it_sends_no_joint_farther_than_its_watchdog_lets_it_get(
    joint: Joint, act: Callable[[Joint], object]
) -> None:
    moving = joint.set_off(lambda: act(joint))
    with joint.held_up():
        pass
    error = moving.wait().error
    assert_nothing_sends_it_away(joint)
    assert isinstance(error, DeviceFault)
    assert "held up for 1." in str(error)


def test_S06_held_up_in_a_cycle_a_stop_that_came_meanwhile_sends_no_joint_farther_either(joint: Joint) -> None:
    moving = joint.set_off(joint.move)
    with joint.held_up():
        stopping = Outcome(joint.motor.stop)
        wait_until(lambda: joint.motor._exchange._stops, "the stop is admitted")  # type: ignore[attr-defined]
    stopping.wait()
    assert_nothing_sends_it_away(joint)
    assert isinstance(moving.wait().error, DeviceFault | MotionStopped)


@pytest.mark.parametrize("act", [Joint.move, Joint.follow, Joint.turn])
def test_S06_what_moved_when_its_host_was_suspended_does_not_continue(
    joint: Joint, act: Callable[[Joint], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock of everything else does not run meanwhile: it is as if nothing had happened."""
    moving = joint.set_off(lambda: act(joint))
    exchange = joint.motor._exchange  # type: ignore[attr-defined]
    clock = exchange.lasting_clock
    joint.woke_up()
    monkeypatch.setattr(exchange, "lasting_clock", lambda: clock() + 3600 * 10**9)
    error = moving.wait().error
    assert_nothing_sends_it_away(joint)
    assert not joint.moving
    if act is not Joint.turn:  # whose call was answered when it began
        assert isinstance(error, DeviceFault)
        assert "held up for 3600." in str(error)


def test_S06_a_driver_that_is_held_up_for_less_continues(joint: Joint) -> None:
    moving = joint.set_off(joint.move)
    job = _HoldUp(joint.motor)
    job.exchange.submit(job)
    assert job.reached.wait(PATIENCE_S)
    sleep_past(time.monotonic_ns() + int(WATCHDOG_S * 0.3e9))
    job.go.set()
    assert moving.wait().error is None
    assert joint.rad == pytest.approx(0.95, abs=0.03)
