"""S23 for zeros: an angle is compared with the last known one before any motion, as a loss of power may shift it."""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from math import inf, tau
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from tests.support.simulated_robots import HEAD
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Rig, written_now
from tests.unit.drivers.legs import Leg
from tests.unit.drivers.motor_rig import KINDS, ODRIVE
from tests.unit.drivers.tail_rig import TailRig
from trade.errors import ConfigurationError, DeviceFault, TradeError
from trade_drivers import AttachedRobot, Joint, Motor, parse
from trade_drivers.bus._angle_store import AngleStore
from trade_drivers.joints._zero import Zero
from trade_drivers.plugins._validate import check
from trade_drivers.vendors.odrive._axis import OdriveAxis
from trade_hil_sim import Absent, BrownOut, Place

pytestmark = pytest.mark.virtual_time

FIRST = 1


class Kind(NamedTuple):
    """A kind of device, and how it loses its zero."""

    rig: Callable[[ExitStack], Leg]
    joint: str
    counts_per_rad: float
    """Of the simulator, for one rad of the joint."""
    wide: tuple[tuple[str, str], ...]
    """Changes of the robot file, for a joint that ranges wide enough."""
    zero: str
    """What a loss of power does to the zero."""
    was_rad: float
    reports_rad: float


_MORE = ("min_rad = -1.0\nmax_rad = 1.0", "min_rad = -0.5\nmax_rad = 4.2")
TURN_8 = tau / 8
KINDS_OF_LOSS = {
    "damiao": Kind(KINDS["damiao"], "tail.root", 1000, (_MORE,), "turn", 3.6, 3.6 - tau),
    "odrive-turn": Kind(KINDS["odrive"], "tail.root", 8000 / tau, (), "turn", 0.9, 0.9 - TURN_8),
    "odrive-lost": Kind(KINDS["odrive"], "tail.root", 8000 / tau, (), "lost", 0.9, 0.0),
    "cia402-lost": Kind(Leg, "leg.hip", 4096 * 50 / tau, (), "lost", 0.9, 0.0),
    "cia402-turn": Kind(Leg, "leg.hip", 4096 * 50 / tau, (), "turn", 0.9, 0.9 - 7 * tau / 50),
}


class Bench:
    """One joint on a simulated bus, and where its shaft really is."""

    def __init__(self, kind: Kind, undo: ExitStack, folder: Path) -> None:
        self.kind, self.folder = kind, folder
        self.rig = kind.rig(undo)
        self.rig.configure(*kind.wide)
        self.rig.plug()
        self.turn(kind.was_rad)

    def configure(self, *changes: tuple[str, str]) -> None:
        """The robot file, with the simulator's port in it: such a bus saves its angles."""
        _, _, channel = self.rig.sim.port.partition(":")
        port = ('interface = "socketcan"\nchannel = "can0"', f'interface = "socketcand"\nchannel = "{channel}"')
        self.rig.configure(*self.kind.wide, port, *changes)

    def attach(self) -> AttachedRobot:
        """Attach, with a folder for what outlives the process."""
        if "socketcand" not in self.rig.text:
            self.configure()
        return self.rig.attach(ports={}, state_dir=self.folder)

    def turn(self, to_rad: float) -> None:
        """Turn the joint by hand, as the device reports it."""
        self.rig.sim.do(Place(ids=(FIRST,), counts=round(to_rad * self.kind.counts_per_rad)))

    def lose_power(self, zero: str) -> None:
        """Let its supply dip while no driver is attached, or while it is not heard."""
        self.rig.sim.do(BrownOut(ids=(FIRST,), zero=zero))  # type: ignore[arg-type]

    @property
    def shaft(self) -> float:
        """Where the joint really is, whatever its zero."""
        return self.rig.truth(FIRST).position_rad

    def refuses(self, motor: Motor, reports_rad: float, since: float) -> None:
        """Check that it says both angles, and that nothing was sent that moves, holds or switches torque on."""
        was_rad = self.kind.was_rad
        for act in (motor.enable, lambda: motor.move_to(0.5), lambda: motor.set_velocity(0.1)):
            with pytest.raises(DeviceFault, match=f"reports {reports_rad:.3f} rad, but.* {was_rad:.3f} rad"):
                act()
        assert not self.rig.events("torque_on", FIRST, since)
        assert not self.rig.events("motion_started", FIRST, since)
        assert self.shaft == pytest.approx(was_rad, abs=2e-3)


@pytest.fixture(params=list(KINDS_OF_LOSS))
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    with ExitStack() as undo:
        yield Bench(KINDS_OF_LOSS[request.param], undo, tmp_path)


@pytest.fixture
def damiao(tmp_path: Path) -> Iterator[Bench]:
    with ExitStack() as undo:
        yield Bench(KINDS_OF_LOSS["damiao"], undo, tmp_path)


def measured(motor: Motor) -> float:
    return motor.state().position_rad


def test_S23_a_zero_lost_between_two_drivers_is_refused_with_both_angles(bench: Bench) -> None:
    with bench.attach() as robot:
        assert measured(robot.motor(bench.kind.joint)) == pytest.approx(bench.kind.was_rad, abs=1e-2)
    bench.lose_power(bench.kind.zero)
    mark = written_now()
    motor = bench.attach().motor(bench.kind.joint)
    assert measured(motor) == pytest.approx(bench.kind.reports_rad, abs=1e-2)
    bench.refuses(motor, measured(motor), mark)
    wait_until(lambda: f"{bench.kind.was_rad:.3f} rad" in motor.state().fault, "the fault says so, too")


def test_S23_a_zero_kept_between_two_drivers_is_believed(bench: Bench) -> None:
    bench.attach().close()
    bench.lose_power("kept")
    motor = bench.attach().motor(bench.kind.joint)
    motor.enable()
    assert motor.move_to(bench.kind.was_rad - 0.3) == pytest.approx(bench.kind.was_rad - 0.3, abs=0.01)
    assert bench.shaft == pytest.approx(bench.kind.was_rad - 0.3, abs=0.01)


def test_S23_a_dip_of_power_while_the_driver_is_up_is_a_fault_with_both_angles(bench: Bench) -> None:
    motor = bench.attach().motor(bench.kind.joint)
    motor.enable()
    mark = written_now()
    bench.lose_power(bench.kind.zero)
    wait_until(lambda: "its zero is in doubt" in fault(motor), "the dip is a fault")
    bench.refuses(motor, measured(motor), mark)


@pytest.mark.parametrize(("stood_s", "doubts"), [(0.0, True), (0.6, False)])
def test_S23_an_angle_is_where_the_joint_was_until_it_was_read_if_the_driver_stood_still(
    stood_s: float, doubts: bool
) -> None:
    """A measurement counts from its request on, which may be long before the joint answered."""
    [joint] = parse(ODRIVE, "tail.toml").joints[:1]
    axis = OdriveAxis("rosie.tail.root", "can0", joint, 100.0)
    axis.silent, axis.zero.period_s, axis.zero.unled_s = False, 0.01, 0.6
    for angle_rad, asked_ns, late_s in ((0.0, 10**9, 0.0), (0.8, 10**9 + 10**7, stood_s)):
        axis.asked_ns = asked_ns
        axis.measured_at(axis.scale.counts(angle_rad), 0.0, 0.0, asked_ns + round(late_s * 1e9))
        axis.motion = SimpleNamespace()  # type: ignore[assignment]
        axis.tell_moving()
    assert axis.zero.in_doubt == doubts


@pytest.mark.parametrize("row", [("abc", "def"), (None, None), (inf, inf), (1.0, -1.0), (b"x", 1.0)], ids=str)
def test_S23_a_saved_angle_that_is_none_is_refused_before_a_bus_is_opened(
    damiao: Bench, row: tuple[object, object]
) -> None:
    damiao.attach().close()
    [file] = (damiao.folder / "angles").glob("*.sqlite")
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("insert or replace into angle values (?, ?, ?)", (damiao.kind.joint, *row))
    mark = written_now()
    with pytest.raises(
        ConfigurationError, match=rf"{file.name}: .* of {damiao.kind.joint} is .*Delete this file, and compare"
    ):
        damiao.attach()
    assert not damiao.rig.frames(since=mark)
    file.unlink()
    damiao.attach().motor(damiao.kind.joint)


def fault(motor: Motor) -> str:
    try:
        return motor.state().fault
    except TradeError:
        return ""


def test_S23_a_relaxed_joint_that_was_not_heard_is_compared_when_it_is_back(bench: Bench) -> None:
    motor = bench.attach().motor(bench.kind.joint)
    mark = written_now()
    bench.rig.sim.do(Absent(ids=(FIRST,)))
    wait_until(lambda: not answers(motor), "it is not heard")
    bench.lose_power(bench.kind.zero)
    bench.rig.sim.do(Absent(ids=(FIRST,), on=False))
    wait_until(lambda: answers(motor), "it is back")
    bench.refuses(motor, measured(motor), mark)


def answers(motor: Motor) -> bool:
    try:
        motor.state()
    except TradeError:
        return False
    return True


def test_S23_a_joint_in_doubt_is_believed_where_it_was_last(bench: Bench) -> None:
    bench.attach().close()
    bench.turn(bench.kind.reports_rad)  # by hand, which looks the same
    motor = bench.attach().motor(bench.kind.joint)
    with pytest.raises(DeviceFault, match="in doubt"):
        motor.enable()
    bench.turn(bench.kind.was_rad)
    wait_until(lambda: measured(motor) == pytest.approx(bench.kind.was_rad, abs=1e-2), "it is measured there")
    motor.enable()
    assert motor.move_to(0.5) == pytest.approx(0.5, abs=0.01)


def test_S23_a_corrected_offset_is_believed(bench: Bench) -> None:
    bench.attach().close()
    bench.lose_power(bench.kind.zero)
    shift = bench.kind.was_rad - bench.kind.reports_rad
    bench.configure(("id = 1\n", f"id = 1\noffset_rad = {shift}\n"))
    motor = bench.attach().motor(bench.kind.joint)
    assert measured(motor) == pytest.approx(bench.kind.was_rad, abs=1e-2)
    motor.enable()
    assert motor.move_to(0.5) == pytest.approx(0.5, abs=0.01)
    assert bench.shaft == pytest.approx(0.5, abs=0.01)


def test_S23_a_device_that_keeps_its_zero_is_not_compared(bench: Bench) -> None:
    last = 'zero = "last"'
    bench.configure((last, 'zero = "kept"') if last in bench.rig.text else ("id = 1\n", 'id = 1\nzero = "kept"\n'))
    bench.attach().close()
    bench.turn(0.2)
    bench.attach().motor(bench.kind.joint).enable()
    assert not saved(bench)


def test_S23_an_angle_that_could_not_be_saved_is_saved_once_the_disk_accepts_it_again(damiao: Bench) -> None:
    blocked = damiao.folder / "angles"
    blocked.touch()  # where the folder has to be
    with closing(damiao.attach()) as robot:
        motor = robot.motor("tail.root")
        motor.enable()
        motor.move_to(3.0)
        wait_until(lambda: not motor.state().moving)
        blocked.unlink()
        wait_until(lambda: blocked.is_dir() and saved(damiao), "it is saved, although the joint does not move")


def saved(bench: Bench) -> list[str]:
    store = AngleStore(bench.folder / "angles" / "rosie.sqlite", print)
    try:
        return [joint for joint in store.load() if joint == bench.kind.joint]
    finally:
        store.close()


def test_S23_an_angle_outside_the_range_that_a_turn_would_put_inside_is_refused_with_both(damiao: Bench) -> None:
    damiao.lose_power("turn")
    mark = written_now()
    motor = damiao.rig.attach().motor("tail.root")  # it has never been attached, and nothing is saved
    damiao.refuses(motor, measured(motor), mark)


def test_S23_an_angle_inside_the_range_is_believed_at_the_first_start(damiao: Bench) -> None:
    damiao.turn(3.0)
    motor = damiao.rig.attach().motor("tail.root")
    motor.enable()
    assert motor.move_to(1.0) == pytest.approx(1.0, abs=0.01)
    assert damiao.shaft == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("kind", ["damiao", "odrive"])
def test_S23_a_range_wider_than_a_turn_says_how_its_zero_is_known(kind: str) -> None:
    with ExitStack() as undo:
        rig = KINDS[kind](undo)
        wide = ("min_rad = -1.0\nmax_rad = 1.0", "min_rad = -3.2\nmax_rad = 3.2")
        unsaid = (('zero = "last"', ""),) if kind == "odrive" else ()
        rig.configure(wide, *unsaid)
        rig.plug()
        turn_rad = tau / rig.robot.joints[0].gear
        with pytest.raises(ConfigurationError, match=rf"zero.*range is 6\.4 rad.* {turn_rad:.4g} rad"):
            rig.attach()
        assert not [entry for entry in rig.frames() if entry.direction == "in"]  # an ODrive sends by itself
        rig.configure(wide, *unsaid, ("id = 1\n", 'id = 1\nzero = "last"\n'), ("id = 2\n", 'id = 2\nzero = "kept"\n'))
        rig.attach().motor("tail.root").enable()


def test_S23_homing_ends_the_doubt(tmp_path: Path) -> None:
    with ExitStack() as undo:
        bench = Bench(KINDS_OF_LOSS["cia402-lost"], undo, tmp_path)
        bench.attach().close()
        bench.lose_power("lost")
        motor: Any = bench.attach().motor("leg.hip")
        with pytest.raises(DeviceFault, match="in doubt"):
            motor.enable()
        assert motor.home() == pytest.approx(0.0, abs=1e-3)
        motor.enable()
        assert motor.move_to(0.2) == pytest.approx(0.2, abs=0.01)


def test_S23_a_homing_that_fails_leaves_the_doubt(tmp_path: Path) -> None:
    with ExitStack() as undo:
        bench = Bench(KINDS_OF_LOSS["cia402-lost"], undo, tmp_path)
        bench.attach().close()
        bench.lose_power("lost")
        motor: Any = bench.attach().motor("leg.hip")
        with pytest.raises(DeviceFault):
            motor.home(method=36)
        with pytest.raises(DeviceFault, match=r"in doubt.* 0\.900 rad"):
            motor.move_to(0.2)


def test_S23_a_servo_does_not_take_the_key() -> None:
    text = HEAD.replace("id = 1\n", 'id = 1\nzero = "last"\n')
    assert text != HEAD
    with pytest.raises(ConfigurationError, match=r"\.zero.*servo knows its angle"):
        check(parse(text, "head.toml"))


def joint_of(**keys: Any) -> Joint:
    keys = {"min_rad": 0.0, "max_rad": 4.2, "max_speed_rad_s": 2.0, "max_accel_rad_s2": 10.0, **keys}
    return Joint(name="a", bus="b", id=1, model="DM4310", **keys)


def zero_of(*, within_turn: bool, **keys: Any) -> Zero:
    zero = Zero(joint_of(**keys), within_turn=within_turn)
    zero.period_s, zero.unled_s = 0.01, 0.4  # a reach of 1 rad at its full speed
    return zero


def test_S23_a_driver_that_died_while_a_joint_moved_finds_it_within_its_reach() -> None:
    zero = zero_of(within_turn=False)
    zero.measured(2.0, 0.0)
    assert zero.to_save() == (2.0, 2.0)
    zero.moving(2.0)
    saved = zero.to_save()
    assert saved is not None
    for angle_rad, doubted in ((0.2, True), (1.0, False), (3.0, False), (3.8, True)):
        after = zero_of(within_turn=False)
        after.measured(angle_rad, 0.0)
        after.restore(saved, angle_rad)
        assert bool(after.doubt(angle_rad)) == doubted, angle_rad


def test_S23_a_moving_joint_is_saved_a_few_times_a_second_and_once_at_rest() -> None:
    zero = zero_of(within_turn=False)
    saves: list[Any] = []
    for number in range(200):  # 4 s at 1 rad/s, in cycles of 20 ms
        zero.measured(number / 50, 0.02)
        zero.moving(2.0)
        saves.append(zero.to_save())
    assert 4 <= len([saved for saved in saves if saved is not None]) <= 9
    zero.measured(3.99, 0.01)
    assert zero.to_save() == (3.99, 3.99)
    zero.measured(3.991, 0.01)
    assert zero.to_save() is None


def test_S23_an_angle_in_doubt_is_not_saved() -> None:
    zero = zero_of(within_turn=True)
    zero.measured(3.6, 0.0)
    assert zero.to_save() == (3.6, 3.6)
    zero.measured(3.6 - tau, 0.01)
    assert zero.doubt(3.6 - tau)
    assert zero.to_save() is None


@pytest.mark.parametrize("gap_s", [0.01, 0.2, 5.0])
def test_S23_a_jump_of_a_resting_joint_is_a_doubt_after_any_gap(gap_s: float) -> None:
    zero = zero_of(within_turn=False)
    zero.measured(1.0, 0.0)
    zero.measured(0.0, gap_s)
    assert zero.doubt(0.0)
    zero.measured(1.0, 0.01)
    assert not zero.doubt(1.0)


def test_S23_a_joint_turned_by_hand_while_it_is_watched_is_believed() -> None:
    zero = zero_of(within_turn=False)
    for number in range(100):
        zero.measured(number / 20, 0.01)  # 5 rad/s
        assert not zero.doubt(number / 20)


@pytest.fixture
def servo(rig: Rig, tmp_path: Path) -> Rig:
    """A head whose bus saves its angles."""
    rig.configure(("/dev/ttyNOWHERE", str(tmp_path / "neck")))
    rig.plug()
    return rig


def turn_past_its_end(rig: Rig, motor: Motor) -> None:
    for counts in (3500, 5000, 4096 + 1500):
        rig.sim.do(Place(ids=(FIRST,), counts=counts))
        wait_until(lambda: measured(motor) == pytest.approx(angle(counts), abs=0.01), "it is measured there")  # noqa: B023 - at once


def angle(counts: int) -> float:
    return (counts - 2048) * tau / 4096


@pytest.mark.parametrize("up", [True, False], ids=["driver up", "driver down"])
def test_S23_a_servo_past_the_end_of_its_turn_is_refused_after_a_loss_of_power(
    servo: Rig, tmp_path: Path, up: bool
) -> None:
    robot = servo.attach(ports={}, state_dir=tmp_path)
    turn_past_its_end(servo, robot.motor("neck.pan"))
    if not up:
        robot.close()
    servo.sim.do(BrownOut(ids=(FIRST,)))
    mark = written_now()
    if not up:
        robot = servo.attach(ports={}, state_dir=tmp_path)
    motor = robot.motor("neck.pan")
    wait_until(lambda: answers(motor) and measured(motor) == pytest.approx(angle(1500), abs=0.01), "it reports less")
    for act in (motor.enable, lambda: motor.move_to(0.5)):
        with pytest.raises(DeviceFault, match=f"reports {angle(1500):.3f} rad, but.* {angle(4096 + 1500):.3f} rad"):
            act()
    assert not servo.moves(FIRST, mark)
    assert not servo.events("torque_on", FIRST, mark)


def test_S23_a_servo_whose_angle_jumps_by_its_turn_is_not_enabled(tmp_path: Path) -> None:
    with ExitStack() as undo:
        tail = TailRig(tmp_path, undo)
        tail.plug()
        motor = tail.root()
        for counts in (3000, 3900, 5):  # a Feetech servo reads 5 after 4095
            tail.sim.do(Place(ids=(FIRST,), counts=counts))
            wait_until(lambda: measured(motor) == pytest.approx(angle(counts), abs=0.01), "it is measured there")  # noqa: B023 - at once
        with pytest.raises(DeviceFault, match=f"reports {angle(5):.3f} rad, but.* {angle(3900):.3f} rad"):
            motor.enable()
        assert not tail.moves(FIRST)
