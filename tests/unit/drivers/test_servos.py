"""What servos of both vendors do alike; the judge is what the simulated servos received and did."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import trade_hil_sim as sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Rig, written_now
from tests.unit.drivers.tail_rig import TailRig
from trade.errors import ConfigurationError, DeviceSilent
from trade_drivers import AttachedRobot, MotorState

pytestmark = pytest.mark.virtual_time

FAST = ('driver = "dynamixel"', 'driver = "dynamixel"\nfast_sync = true')


@pytest.fixture(params=["dynamixel", "dynamixel, fast sync", "feetech"])
def servos(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig | TailRig]:
    with ExitStack() as undo:
        made = TailRig(tmp_path, undo) if request.param == "feetech" else Rig(tmp_path, undo)
        if "fast" in request.param:
            made.configure(FAST)
        yield made


@pytest.fixture
def robot(servos: Rig | TailRig) -> AttachedRobot:
    servos.plug()
    return servos.attach()


def state(robot: AttachedRobot, joint: str) -> MotorState | None:
    """The state, or None while it is silent."""
    try:
        return robot.motor(joint).state()
    except DeviceSilent:
        return None


@pytest.mark.parametrize(
    "fault",
    [
        sim.Mute(ids=(1,), count=1),
        sim.Truncate(ids=(1,), count=1),
        sim.Duplicate(ids=(1,), count=3),
        sim.Dribble(ids=(1,), count=3, s=0.0005),
        sim.Dribble(ids=(1,), count=1, s=0.006),
    ],
    ids=lambda fault: f"{type(fault).__name__} {fault.count}",
)
def test_a_few_bad_answers_go_unnoticed(servos: Rig | TailRig, robot: AttachedRobot, fault: sim.Command) -> None:
    joint = robot.motor(servos.first)
    joint.enable()
    servos.sim.do(fault)
    assert joint.move_to(0.4) == pytest.approx(0.4, abs=0.03)
    assert joint.state().fault == ""


@pytest.mark.parametrize("late_s", [0.033, 0.040, 0.060, 0.066, 0.080, 0.1, 0.15])
def test_a_late_answer_never_becomes_a_wrong_value(servos: Rig | TailRig, robot: AttachedRobot, late_s: float) -> None:
    robot.motor(servos.first).move_to(0.5)
    servos.sim.do(sim.Late(ids=(1,), s=late_s, count=2))
    servos.sim.do(sim.Place(ids=(2,), counts=2148))
    begun = written_now()

    def plausible() -> bool:
        first, second = state(robot, servos.first), state(robot, servos.second)
        assert first is None or first.position_rad == pytest.approx(0.5, abs=0.01)
        assert first is None or (first.temperature_c, first.fault) == (30.0, "")
        assert second is None or second.position_rad == pytest.approx(0, abs=0.01) or second.position_rad < -0.14
        return first is not None and first.measured_at > begun + 0.5

    wait_until(plausible, "later measurements came in")


def test_a_silent_joint_leaves_the_other_usable(servos: Rig | TailRig, robot: AttachedRobot) -> None:
    servos.sim.do(sim.Mute(ids=(1,)))
    wait_until(lambda: state(robot, servos.first) is None, "it is silent")
    second = robot.motor(servos.second)
    assert second.move_to(0.4) == pytest.approx(0.4, abs=0.03)
    assert second.state().age_s < 1
    for act in (lambda: robot.motor(servos.first).move_to(0.1), robot.group(servos.group).state):
        with pytest.raises(DeviceSilent, match=rf"rosie\.{servos.first}"):
            act()


def test_an_adapter_that_echoes_is_no_trouble(servos: Rig | TailRig) -> None:
    servos.plug().do(sim.Echo())
    robot = servos.attach()
    assert robot.motor(servos.first).move_to(0.3) == pytest.approx(0.3, abs=0.03)
    assert robot.motor(servos.second).state().fault == ""


@pytest.mark.parametrize(
    ("ids", "baud", "says"),
    [((1, 1, 2), 1_000_000, "two devices may share this id"), ((1, 2), 115_200, "baud rate (register")],
    ids=["one id twice", "another baud rate"],
)
def test_what_another_set_up_looks_like_is_said(
    servos: Rig | TailRig, ids: tuple[int, ...], baud: int, says: str
) -> None:
    servos.plug(*(servos.servo_class(device_id, baud=baud) for device_id in ids))
    with pytest.raises(ConfigurationError) as refused:
        servos.attach()
    assert says in str(refused.value)
    assert not servos.announced
    assert not sim.writes(servos.log)


def test_S18_what_is_found_moving_is_stopped(servos: Rig | TailRig) -> None:
    servos.plug(prepare=lambda _: servos.move_by_another(3900))
    servos.wait_for("motion_started", 1)
    servos.attach()
    servos.wait_for("at_rest", 1)
    assert servos.truth(1).position_counts < 3800
    assert abs(servos.goal_of(servos.goals(1)[-1]) - servos.truth(1).position_counts) <= 3
    assert not servos.goals(2)


def test_S18_enabling_sets_the_goal_to_the_measured_position_before_torque_is_on(
    servos: Rig | TailRig, robot: AttachedRobot
) -> None:
    joint = robot.motor(servos.first)
    servos.sim.do(sim.Place(ids=(1,), counts=2400))
    wait_until(lambda: joint.state().position_rad > 0.5, "the new place is measured")
    joint.enable()
    goal, *_, torque = servos.moves(1)
    assert (servos.goal_of(goal), "torque_enable" in goal.registers) == (2400, False)
    assert torque.registers == ("torque_enable",)
    assert servos.truth(1).position_counts == 2400
    assert not servos.events("motion_started", 1)
