"""A servo's own range, which its registers hold, against the robot file and against the place of the joint.

A servo cannot hold outside its own range: it turns each goal there into the end of the range, or ignores it.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from math import tau
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import serial  # noqa: F401 - virtual time replaces it only if it was imported before  # pyright: ignore[reportUnusedImport]

from tests.contract.rigs.base import answers
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig, goal_counts, written_now
from tests.unit.drivers.tail_rig import TailRig, goal_of
from trade.errors import DeviceFault
from trade_drivers import Motor
from trade_hil_sim import Absent, BrownOut, LogEntry, Place, writes

pytestmark = pytest.mark.virtual_time

LOW, HIGH = 1000, 3000
SLOWLY_RAD_S = 0.3


class Kind(NamedTuple):
    """One vendor's servo with a range of its own: its rig, its joint, and its registers."""

    rig: Callable[[Path, ExitStack], Any]
    joint: str
    group: str
    registers: tuple[str, str]
    """Names of those of the low and the high end."""
    addresses: tuple[int, int]
    goal_of: Callable[[LogEntry], int]
    slowest_rad_s: float


KINDS = {
    "feetech": Kind(TailRig, "tail.root", "tail", ("min_angle", "max_angle"), (9, 11), goal_of, 0.016),
    "dynamixel": Kind(
        Rig, "neck.pan", "head", ("min_position_limit", "max_position_limit"), (52, 48), goal_counts, 0.049
    ),
}


class Bench:
    """A servo whose own range is from LOW to HIGH, and its driver."""

    def __init__(self, kind: Kind, folder: Path, undo: ExitStack) -> None:
        self.kind, self.rig = kind, kind.rig(folder, undo)

    def plug(self, at: int) -> None:
        self.rig.plug()
        self.own_range(LOW, HIGH)
        self.place(at)

    def own_range(self, low: int, high: int) -> None:
        self.keep(**dict(zip(self.kind.registers, (low, high), strict=True)))

    def keep(self, **values: int) -> None:
        """Set registers that outlast a loss of power."""
        for name, value in values.items():
            self.servo.memory.set(name, value)
            if self.kind.rig is TailRig:
                self.servo.memory.keep(name)

    @property
    def servo(self) -> Any:
        return next(servo for servo in self.rig.sim.devices if servo.device_id == 1)

    def place(self, counts: int) -> None:
        self.rig.sim.do(Place(ids=(1,), counts=counts))

    def motor(self) -> Motor:
        robot = self.rig.attach()
        self.group = robot.group(self.kind.group)
        motor: Motor = robot.motor(self.kind.joint)
        return motor

    def truth(self) -> Any:
        return self.rig.truth(1)

    def refusal(self, command: Callable[[], object], *shown: str) -> None:
        """The command is refused with these words, nothing is written, and the shaft stays without torque."""
        mark, before = written_now(), self.truth().position_counts
        with pytest.raises(DeviceFault) as refused:
            command()
        for words in shown:
            assert words in str(refused.value)
        assert not writes(self.rig.log, device_id=1, since=mark)
        assert not self.rig.events("motion_started", 1)
        assert (self.truth().position_counts, self.truth().torque) == (before, False)


@pytest.fixture(params=list(KINDS))
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    with ExitStack() as undo:
        yield Bench(KINDS[request.param], tmp_path, undo)


def rad(counts: int) -> str:
    return f"{(counts - 2048) * tau / 4096:.3f} rad"


@pytest.mark.parametrize(("at", "end"), [(3100, 1), (900, 0)])
def test_S23_a_servo_outside_its_own_range_is_not_enabled_and_both_angles_are_in_the_error(
    bench: Bench, at: int, end: int
) -> None:
    bench.plug(at)
    motor = bench.motor()
    shown = (f"register {bench.kind.addresses[end]}", rad((LOW, HIGH)[end]), rad(at), "by hand")
    bench.refusal(motor.enable, *shown)
    bench.refusal(lambda: motor.move_to(0.2), *shown)
    bench.refusal(lambda: motor.set_velocity(0.1 if at < LOW else -0.1, 1.0), *shown)
    bench.refusal(bench.group.enable, *shown)
    bench.refusal(lambda: bench.group.servo([0.2, 0.0]), *shown)
    motor.stop()
    assert not writes(bench.rig.log, device_id=1)


def test_a_servo_within_its_own_range_is_enabled_without_motion(bench: Bench) -> None:
    bench.plug(2990)
    bench.motor().enable()
    assert (bench.truth().position_counts, bench.truth().torque) == (2990, True)
    assert not bench.rig.events("motion_started", 1)


def test_a_servo_that_rests_at_the_end_of_its_own_range_is_enabled_with_the_end_as_its_goal(bench: Bench) -> None:
    """A joint comes to rest up to four counts from its goal, which is the driver's own tolerance."""
    bench.plug(3004)
    bench.motor().enable()
    assert [bench.kind.goal_of(entry) for entry in bench.rig.goals(1)] == [3000]
    assert bench.truth().torque


def test_S23_a_mode_that_was_lost_with_the_power_is_a_fault_before_the_next_enabling(bench: Bench) -> None:
    bench.plug(2048)
    motor = bench.motor()
    motor.enable()
    bench.rig.sim.do(BrownOut(ids=(1,)))
    bench.keep(**{"mode" if bench.kind.rig is TailRig else "operating_mode": 1})
    wait_until(lambda: motor.state().fault, "the loss of power is noticed")
    mark = written_now()
    with pytest.raises(DeviceFault, match="mode"):
        motor.enable()
    assert not bench.rig.goals(1, mark)
    assert not bench.truth().torque


def test_S23_a_range_that_changed_while_the_servo_was_away_is_a_fault_and_nothing_is_sent(bench: Bench) -> None:
    bench.plug(2048)
    motor = bench.motor()
    motor.enable()
    bench.rig.sim.do(Absent(ids=(1,)))
    [axis] = motor._axes  # type: ignore[attr-defined]
    wait_until(lambda: axis.silent, "it is away")
    bench.own_range(1800, 2200)
    mark = written_now()
    bench.rig.sim.do(Absent(ids=(1,), on=False))
    wait_until(lambda: answers(motor.state), "it is back")
    assert "more than the device's own range" in motor.state().fault
    with pytest.raises(DeviceFault, match="more than the device's own range"):
        motor.move_to(0.5)
    assert not bench.rig.goals(1, mark)


def test_S23_a_stop_outside_the_own_range_slows_to_the_least_speed_and_says_that_it_cannot_hold(bench: Bench) -> None:
    """The joint was pushed out while enabled, and is on its way back."""
    bench.plug(2048)
    motor = bench.motor()
    motor.enable()
    bench.place(3900)
    mark = written_now()
    moving = Outcome(lambda: motor.move_to(0.0, SLOWLY_RAD_S))
    wait_until(lambda: bench.rig.goals(1, mark) or moving.error, "it is on its way back")
    stopped = written_now()
    with pytest.raises(DeviceFault) as cannot:
        motor.stop()
    assert moving.wait().error is not None
    assert f"register {bench.kind.addresses[1]}" in str(cannot.value)
    assert rad(HIGH) in str(cannot.value)
    assert 0 < abs(bench.truth().velocity_rad_s) <= bench.kind.slowest_rad_s
    assert {bench.kind.goal_of(entry) for entry in bench.rig.goals(1, stopped)} == {HIGH}
    assert bench.truth().position_counts > 3500


def test_a_stop_within_the_own_range_holds(bench: Bench) -> None:
    bench.plug(2048)
    motor = bench.motor()
    motor.enable()
    moving = Outcome(lambda: motor.move_to(1.0, SLOWLY_RAD_S))
    wait_until(lambda: bench.truth().position_counts > 2200 or moving.error, "it is under way")
    motor.stop()
    assert moving.wait().error is not None
    assert bench.truth().position_counts < 2400
    assert bench.truth().velocity_rad_s == 0
