"""The contract of grippers on a 2F-85, and what is its own."""

from pathlib import Path

import pytest

from tests.support.simulated_robots import HAND, HEAD
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.gripper_rig import HandRig, hand, rig
from trade.errors import ConfigurationError, DeviceFault, MotionStopped
from trade_drivers import Gripper, SerialBus, attach, parse
from trade_drivers.testing import GripperContract
from trade_drivers.vendors.robotiq import _table as table
from trade_hil_sim import DynamixelBus, Put
from trade_hil_sim.robotiq import _table as simulated

pytestmark = pytest.mark.virtual_time

__all__ = ["hand", "rig"]


class TestRobotiqGripper(GripperContract):
    @pytest.fixture
    def gripper(self, hand: HandRig) -> Gripper:
        return hand.active()


def test_a_gripper_becomes_a_provider_in_the_group_named_after_it(hand: HandRig) -> None:
    robot = hand.attach()
    assert hand.announced == [("rosie.left.hand",), ("rosie.faults",)]
    assert robot.gripper("left.hand").members == {"rosie": ["rosie.left.hand"], "rosie.left": ["rosie.left.hand"]}
    with pytest.raises(KeyError):
        robot.motor("left.hand")


def test_an_object_is_held_and_the_position_of_the_fingers_shows_its_width(hand: HandRig) -> None:
    hand.sim.do(Put(width_m=0.04, stiffness_n_m=1e6))
    gripper = hand.active()
    state = gripper.close(force_n=40.0)
    assert (state.holding, state.moving) == ("outside", False)
    assert state.width_m == pytest.approx(0.04, abs=0.001)
    assert state.force_n == pytest.approx(40.0, abs=1.0)
    assert hand.truth.force_n == pytest.approx(state.force_n)
    assert gripper.open().holding == ""


def test_a_hollow_object_is_held_from_inside(hand: HandRig) -> None:
    gripper = hand.active()
    gripper.close()
    hand.sim.do(Put(width_m=0.05, inside=True))
    assert gripper.open().holding == "inside"


def test_an_object_that_is_taken_away_is_noticed(hand: HandRig) -> None:
    hand.sim.do(Put(width_m=0.04))
    gripper = hand.active()
    assert gripper.close().holding
    hand.sim.do(Put())
    wait_until(lambda: not gripper.state().holding, "it is lost")


def test_a_stop_keeps_what_is_held_and_follows_it_no_more(hand: HandRig) -> None:
    hand.sim.do(Put(width_m=0.04))
    gripper = hand.active()
    width = gripper.close().width_m
    gripper.stop()
    assert gripper.state().holding == "outside"
    hand.sim.do(Put())
    first = gripper.state()
    wait_until(lambda: gripper.state().measured_at > first.measured_at + 0.1)
    assert gripper.state().width_m == width
    assert not hand.truth.moving


def test_a_stop_of_resting_fingers_writes_nothing(hand: HandRig) -> None:
    gripper = hand.active()
    mark = written_now()
    gripper.stop()
    assert not hand.writes(mark)


def test_a_new_move_takes_over_and_the_old_caller_hears_of_it(hand: HandRig) -> None:
    gripper = hand.active()
    old = Outcome(lambda: gripper.close(0.02))
    wait_until(lambda: hand.truth.moving and hand.truth.width_m < 0.08, "it is under way")
    assert gripper.move_to(0.085).width_m == pytest.approx(0.085, abs=0.001)
    assert isinstance(old.wait().error, MotionStopped)
    assert "another move" in str(old.error)


def test_a_move_to_where_it_is_going_already_is_a_move(hand: HandRig) -> None:
    gripper = hand.active()
    gripper.close()
    assert gripper.close().width_m == pytest.approx(0.0, abs=0.002)


def test_a_deadline_that_passes_on_the_way_stops_the_fingers(hand: HandRig) -> None:
    gripper = hand.active()
    moving = Outcome(lambda: gripper.close(0.02), deadline_s=1.0).wait()
    assert isinstance(moving.error, MotionStopped)
    assert "deadline" in str(moving.error)
    wait_until(lambda: not hand.truth.moving, "it rests")
    assert hand.truth.width_m > 0.03


def test_closing_the_driver_keeps_what_is_held(hand: HandRig) -> None:
    hand.sim.do(Put(width_m=0.04))
    robot = hand.attach()
    robot.gripper("left.hand").activate()
    robot.gripper("left.hand").close()
    mark = written_now()
    robot.close()
    assert not hand.writes(mark)
    assert hand.truth.holding


def test_closing_the_driver_stops_moving_fingers(hand: HandRig) -> None:
    robot = hand.attach()
    robot.gripper("left.hand").activate()
    moving = Outcome(lambda: robot.gripper("left.hand").close(0.02))
    hand.wait_for("motion_started", hand.wait_for("activated").t)
    robot.close()
    assert isinstance(moving.wait().error, MotionStopped)
    assert not hand.truth.moving


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ('"2F-85"', '"2F-140"', "'2F-140' is unknown to the driver robotiq; it knows 2F-85"),
        ("max_width_m = 0.085", "max_width_m = 0.1", "max_width_m: 0.1 is outside of what a 2F-85 can"),
        ("max_speed_m_s = 0.15", "max_speed_m_s = 0.2", "max_speed_m_s: 0.2 is outside"),
        ("max_force_n = 200.0", "max_force_n = 10.0", "max_force_n: 10 is outside"),
        ("baud = 115200", 'baud = 115200\nleave = "relax"', "is nothing a 2F-85 can"),
        ("baud = 115200", "baud = 115200\nwatchdog_s = 0.3", "hand.toml: bus.hand.watchdog_s: a 2F-85 has no watchdog"),
        ("baud = 115200", "baud = 115200\nfast_sync = false", "bus.hand.fast_sync: a 2F-85 has no joined answers"),
        ("baud = 115200", "baud = 115200\nrate_hz = 900", "rate_hz: 1 grippers at 115200 baud need"),
        ("id = 9", "id = 8", "no gripper answers to id 8 on bus 'hand'"),
    ],
)
def test_a_mistake_in_the_file_is_answered_with_what_would_be_right(
    hand: HandRig, before: str, after: str, problem: str
) -> None:
    hand.configure((before, after))
    with pytest.raises(ConfigurationError) as refused:
        hand.attach()
    assert problem in str(refused.value)


def test_a_port_that_is_not_there_is_named(hand: HandRig, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="there is no such device"):
        hand.attach(ports={"hand": str(tmp_path / "nowhere")})


def test_a_gripper_on_a_bus_of_servos_is_refused(tmp_path: Path) -> None:
    text = HEAD + HAND[HAND.index("[gripper") :].replace('"hand"', '"neck"')
    robot = parse(text, "head.toml")
    neck = robot.buses[0]
    assert isinstance(neck, SerialBus)
    with (
        DynamixelBus.from_robot(neck, robot.joints_on("neck"), tmp_path / "neck", paced=False) as bus,
        pytest.raises(ConfigurationError, match=r'gripper."left.hand".bus: .* driver dynamixel, which has no grippers'),
    ):
        attach(robot, ports={"neck": str(bus.port)})


def test_a_joint_on_a_bus_of_grippers_is_refused(hand: HandRig) -> None:
    joint = HEAD[HEAD.index("[joint") : HEAD.index('[joint."neck.tilt"]')].replace('"neck"', '"hand"')
    with pytest.raises(ConfigurationError, match="driver robotiq, which has no joints, only grippers"):
        attach(parse(HAND + joint, "hand.toml"), ports={"hand": str(hand.sim.port)})


def test_a_gripper_that_was_never_activated_does_not_move_and_says_what_to_do(hand: HandRig) -> None:
    gripper = hand.gripper()
    with pytest.raises(DeviceFault, match=r"not activated; call activate\(\)"):
        gripper.close()
    assert not hand.writes()


def test_the_register_tables_of_driver_and_simulator_agree() -> None:
    [model] = table.MODELS
    assert (table.COMMAND, table.STATUS) == (simulated.COMMAND, simulated.STATUS)
    assert (model.open_counts, model.closed_counts) == (simulated.OPEN_COUNTS, simulated.CLOSED_COUNTS)
    for counts in (3, 100, 230):
        assert model.width_m(counts) == pytest.approx(simulated.width_of(counts))
    for request in (0, 100, 255):
        force_n = simulated.force_of(request)
        speed_m_s = simulated.speed_of(request) * model.m_per_count
        assert model.force_counts(force_n) == request
        assert model.speed_counts(speed_m_s) == request


def test_a_width_becomes_the_position_of_that_width_and_the_ends_become_the_whole_range() -> None:
    [model] = table.MODELS
    assert (model.counts(0.0), model.counts(model.stroke_m)) == (255, 0)
    for counts in range(4, 230):
        assert model.counts(model.width_m(counts)) == counts


def test_the_frames_of_the_manual_are_read() -> None:
    status = table.Status.decode([0xB900, 0x00FF, 0xBD00], 0)
    assert (status.activated, status.going, status.contact) == (True, True, table.Contact.CLOSING)
    assert (status.echo, status.position, status.fault) == (0xFF, 0xBD, 0)
    assert table.Status.decode([0x1100, 0, 0], 0).activating
    assert table.command(255, 255, 255) == (0x0900, 0x00FF, 0xFFFF)
