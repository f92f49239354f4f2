"""Modes without a goal: which is used for what, how it is entered and left, what ends it. Frames are the judge."""

import itertools
import threading
from collections.abc import Callable

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import (
    COUNTS_PER_RAD,
    CYCLIC_POSITION,
    CYCLIC_VELOCITY,
    HIP,
    HOMING,
    KNEE,
    PROFILE_POSITION,
    PROFILE_VELOCITY,
    Leg,
    leg,
    only,
    rig,
)
from tests.unit.drivers.test_cia402_motor import through
from trade.errors import DeviceFault, MotionStopped
from trade_drivers import JointGroup, Tolerances
from trade_drivers.joints import Sample
from trade_drivers.motion._plan import Course
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import Following, Turning
from trade_drivers.vendors.cia402._homing import Drive
from trade_drivers.vendors.cia402._verify import interpolation_period
from trade_hil_sim import LogEntry, Mute
from trade_hil_sim.cia402 import Cia402Bus

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]

QUICK_STOP, OPERATE = 0x02, 0x0F
TURNING = [CYCLIC_VELOCITY, PROFILE_VELOCITY]


def written(leg: Leg, index: int, sub: int = 0, joint: int = HIP, since: float = 0.0) -> list[LogEntry]:
    """Requests to write an object."""
    place = index.to_bytes(2, "little") + bytes((sub,))
    found = leg.frames("sdo_request", joint, since)
    return [e for e in found if e.data[0] & 0xE0 == 0x20 and e.data[1:4] == place]


def modes(leg: Leg, joint: int = HIP, since: float = 0.0) -> list[int]:
    return [e.data[4] for e in written(leg, 0x6060, joint=joint, since=since)]


def shown(leg: Leg, mode: int, joint: int = HIP) -> list[LogEntry]:
    """Frames in which the drive says that it is in this mode."""
    return [e for e in leg.frames("tpdo2", joint) if e.data[4] == mode]


def positions(leg: Leg, joint: int = HIP, since: float = 0.0) -> list[int]:
    return [int.from_bytes(e.data, "little", signed=True) for e in leg.frames("rpdo4", joint, since)]


def speeds(leg: Leg, joint: int = HIP, since: float = 0.0) -> list[int]:
    return [int.from_bytes(e.data[4:], "little", signed=True) for e in leg.frames("rpdo3", joint, since)]


def at_rest_when(leg: Leg, moment: float, joint: int = HIP) -> bool:
    before = [e.name for e in leg.log if e.device_id == joint and e.t < moment and e.name in MOTION]
    return not before or before[-1] == "at_rest"


MOTION = ("motion_started", "at_rest")


def swing(group: JointGroup) -> Outcome:
    """A trajectory of 2 s around where the joints are."""
    here = [state.position_rad for state in group.state()]
    there = [angle + 0.4 for angle in here]
    return Outcome(
        lambda: group.follow(through(group, (0.0, here), (1.0, there), (2.0, here)), Tolerances(path_rad=0.5))
    )


def test_drives_that_support_it_receive_a_trajectory_position_at_every_sync(leg: Leg) -> None:
    group = leg.attach().group("leg")
    group.move_to([0.3, 0.1])
    mark = written_now()
    assert swing(group).wait().error is None
    assert modes(leg, HIP, mark) == modes(leg, KNEE, mark) == [CYCLIC_POSITION]
    first = leg.frames("rpdo4", HIP, mark)[0]
    syncs = len(leg.frames("sync", since=first.t))
    assert len(positions(leg, HIP, mark)) == pytest.approx(syncs, abs=3)
    assert len({e.data for e in leg.frames("rpdo4", HIP, mark)}) > syncs / 2
    assert not leg.goals(HIP, mark)
    assert max(positions(leg, HIP, mark)) == pytest.approx(0.7 * COUNTS_PER_RAD, rel=0.02)


def test_nothing_is_sent_in_a_mode_that_the_drive_does_not_show_and_the_first_is_where_it_is(leg: Leg) -> None:
    group = leg.attach().group("leg")
    group.move_to([0.3, 0.1])
    here = leg.frames("tpdo1", HIP)[-1].data
    mark = written_now()
    assert swing(group).wait().error is None
    first = leg.frames("rpdo4", HIP, mark)[0]
    assert shown(leg, CYCLIC_POSITION)[0].t < first.t
    assert first.data == here[2:6]
    [asked] = written(leg, 0x6060, since=mark)
    before = [e for e in leg.frames("rpdo1", HIP) if e.t < asked.t][-1]
    assert before.data[2:] == here[2:6]  # so its target is where it is when the mode changes


def test_positions_count_from_the_next_sync_on_and_are_reached_in_a_period(rig: Leg) -> None:
    rig.configure(('channel = "can0"', 'channel = "can0"\nrate_hz = 80'))
    rig.plug()
    rig.attach()
    assert [e.data[4] for e in written(rig, 0x1403, 2)] == [1]
    assert [e.data[4] for e in written(rig, 0x60C2, 1)] == [125]
    assert [e.data[4] - 256 for e in written(rig, 0x60C2, 2)] == [-4]


def test_a_drive_in_position_mode_is_closer_to_its_trajectory_than_one_with_goals(
    rig: Leg, monkeypatch: pytest.MonkeyPatch
) -> None:
    off: list[float] = []
    monkeypatch.setattr(Course, "note", lambda _, __, error_rad: off.append(abs(error_rad)))
    mean: list[float] = []
    for has in ((PROFILE_POSITION,), (PROFILE_POSITION, CYCLIC_POSITION)):
        leg = Leg(rig._undo)
        leg.plug(prepare=only(*has))
        group = leg.attach().group("leg")
        group.enable()
        off.clear()
        assert swing(group).wait().error is None
        mean.append(sum(off) / len(off))
    assert mean[1] < mean[0] / 2


@pytest.mark.parametrize("mode", TURNING)
def test_S04_a_speed_that_is_not_renewed_ends_in_a_quick_stop_under_torque(rig: Leg, mode: int) -> None:
    rig.plug(prepare=only(PROFILE_POSITION, mode))
    hip = rig.attach().motor("leg.hip")
    mark = written_now()
    hip.set_velocity(0.5, valid_s=0.4)
    started = rig.wait_for("motion_started", HIP, mark)
    assert modes(rig, HIP, mark) == [mode]
    assert max(speeds(rig, HIP, mark)) <= 0.5 * COUNTS_PER_RAD
    rig.wait_for("at_rest", HIP, started.t)
    assert [word for word in rig.controlwords(HIP, started.t) if word != OPERATE] == [QUICK_STOP]
    assert not rig.goals(HIP, mark)
    assert not rig.events("torque_off", HIP, mark)
    assert hip.state().enabled
    hip.move_to(0.0)


def test_speeds_rise_as_the_joint_may_accelerate(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    for _ in range(10):
        hip.set_velocity(-1.0, valid_s=0.5)
    wait_until(lambda: min(speeds(leg)) == -int(COUNTS_PER_RAD), "it has its speed")
    changes = [abs(after - before) for before, after in itertools.pairwise(speeds(leg))]
    assert max(changes) <= 20 * COUNTS_PER_RAD / 100 + 1


@pytest.mark.parametrize("mode", TURNING)
def test_S22_a_speed_ends_within_the_range_also_while_nothing_is_measured(rig: Leg, mode: int) -> None:
    rig.configure(('channel = "can0"', 'channel = "can0"\nstale_after_s = 1.5'))
    rig.plug(prepare=only(PROFILE_POSITION, mode))
    hip = rig.attach().motor("leg.hip")
    hip.enable()
    hip.set_velocity(2.0, valid_s=1.0)
    started = rig.wait_for("motion_started", HIP)
    rig.sim.do(Mute(ids=(HIP,), instruction="tpdo1"))
    rig.wait_for("at_rest", HIP, started.t)
    assert rig.truth(HIP).position_rad <= 1.0 + 1 / COUNTS_PER_RAD


@pytest.mark.parametrize("mode", [*TURNING, PROFILE_POSITION])
def test_S22_a_speed_ends_within_the_range_also_if_the_driver_freezes(
    rig: Leg, mode: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.plug(prepare=only(PROFILE_POSITION, mode))
    hip = rig.attach().motor("leg.hip")
    exchange, thaw = hip._exchange, threading.Event()  # type: ignore[attr-defined]
    cycle = exchange.cycle

    def freeze_late() -> None:
        if rig.truth(HIP).position_rad > 0.6:
            thaw.wait(PATIENCE_S)
        cycle()

    hip.enable()
    monkeypatch.setattr(exchange, "cycle", freeze_late)
    hip.set_velocity(2.0, valid_s=1.0)
    started = rig.wait_for("motion_started", HIP)
    wait_until(lambda: "quick_stop_active" in [e.detail for e in rig.events("state", HIP)], "its watchdog stops it")
    rig.wait_for("at_rest", HIP, started.t)  # a drive with a goal may rest before its watchdog has its say
    assert rig.truth(HIP).position_rad <= 1.0 + 1 / COUNTS_PER_RAD
    thaw.set()


def test_S22_a_speed_comes_to_rest_at_the_end_of_the_range(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    wait_until(lambda: hip.set_velocity(2.0, valid_s=0.5) or hip.state().position_rad > 0.98, "it is at the end")
    assert leg.truth(HIP).position_rad <= 1.001


ASKS: dict[str, Callable[[Drive], object]] = {
    "a move": lambda hip: hip.move_to(0.0),
    "a speed": lambda hip: hip.set_velocity(-0.3, 0.2),
    "a home": lambda hip: hip.home(),
}


@pytest.mark.parametrize("name", ASKS)
@pytest.mark.parametrize("first", ["a trajectory", "a speed", "a move"])
def test_a_mode_never_changes_while_the_drive_moves(leg: Leg, first: str, name: str) -> None:
    robot = leg.attach()
    hip, group = robot.motor("leg.hip"), robot.group("leg")
    assert isinstance(hip, Drive)
    group.move_to([0.1, 0.1])
    mark = written_now()
    match first:
        case "a trajectory":
            moving = swing(group)
        case "a speed":
            moving = Outcome(lambda: hip.set_velocity(0.4, 1.0))
        case _:
            moving = Outcome(lambda: hip.move_to(0.9, 0.3))
    leg.wait_for("motion_started", HIP, mark)
    ASKS[name](hip)
    assert isinstance(moving.wait().error, MotionStopped | None)
    for asked in written(leg, 0x6060, since=mark):
        assert at_rest_when(leg, asked.t), (first, name)
    assert not leg.events("torque_off", HIP, mark)
    assert hip.state().fault == ""


def test_a_drive_holds_its_position_after_a_trajectory_and_moves_again(leg: Leg) -> None:
    robot = leg.attach()
    group, hip = robot.group("leg"), robot.motor("leg.hip")
    assert swing(group).wait().error is None
    mark, reported = written_now(), len(positions(leg))
    wait_until(lambda: len(positions(leg)) > reported + 5, "it gets the position to hold")
    assert len(set(positions(leg, HIP, mark))) == 1
    assert hip.move_to(0.2) == pytest.approx(0.2, abs=0.01)
    assert not leg.events("torque_off", HIP, mark)
    assert QUICK_STOP not in leg.controlwords(HIP, mark)


def test_a_stop_of_a_trajectory_is_a_quick_stop_and_it_moves_again(leg: Leg) -> None:
    robot = leg.attach()
    group = robot.group("leg")
    moving = swing(group)
    started = leg.wait_for("motion_started", KNEE)
    robot.motor("leg.hip").stop()
    assert isinstance(moving.wait().error, MotionStopped)
    for joint in (HIP, KNEE):
        assert leg.controlwords(joint, started.t)[0] == QUICK_STOP
        stopped = leg.wait_for("at_rest", joint, started.t)
        assert not [e for e in leg.frames("rpdo4", joint) if e.t > stopped.t]
    assert group.move_to([0.0, 0.0]) == pytest.approx([0.0, 0.0], abs=0.01)


def test_an_old_target_velocity_does_not_come_to_life_when_it_is_enabled(rig: Leg) -> None:
    rig.plug(prepare=only(PROFILE_POSITION, CYCLIC_VELOCITY))
    hip = rig.attach().motor("leg.hip")
    Outcome(lambda: hip.set_velocity(0.5, valid_s=0.5)).wait()
    rig.wait_for("motion_started", HIP)
    hip.stop()
    assert speeds(rig)[-1] != 0
    rest = written_now()
    hip.set_velocity(-0.3, valid_s=0.3)
    wait_until(lambda: rig.events("motion_started", HIP, rest), "it turns")
    assert max(speeds(rig, HIP, rest)) <= 0


def test_a_drive_without_these_modes_gets_goals(rig: Leg) -> None:
    rig.plug(prepare=only(PROFILE_POSITION, HOMING))
    robot = rig.attach()
    assert swing(robot.group("leg")).wait().error is None
    robot.motor("leg.hip").set_velocity(0.2)
    assert set(modes(rig)) == {PROFILE_POSITION}
    assert not rig.frames("rpdo4")
    assert rig.goals(HIP)


def test_a_drive_that_does_not_show_its_mode_is_not_enabled_in_it(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    leg.sim.do(Mute(ids=(HIP,), instruction="tpdo2"))
    mark = written_now()
    with pytest.raises(DeviceFault, match=r"does not enter mode 9 \(6061h\)"):
        hip.set_velocity(0.2, valid_s=1.0)
    assert not leg.events("torque_on", HIP, mark)


def test_a_drive_that_would_relax_after_a_quick_stop_is_not_used_in_these_modes(rig: Leg) -> None:
    def stubborn(bus: Cia402Bus) -> None:
        for device in bus.devices:
            write = device.store.set  # type: ignore[attr-defined]
            device.store.set = lambda name, value, write=write: (
                None if name == "quick_stop_option" else write(name, value)
            )  # type: ignore[attr-defined]

    rig.plug(prepare=stubborn)
    robot = rig.attach()
    assert swing(robot.group("leg")).wait().error is None
    assert set(modes(rig)) == {PROFILE_POSITION}


def run(stream: Following | Turning, cycles: int, measured: int = 0) -> list[int]:
    layout = table.FOLLOWING.layout if isinstance(stream, Following) else table.TURNING.layout
    frames = [stream.next(Sample(measured, 0, 0, now_ns), now_ns) for now_ns in range(1, cycles + 1)]
    return [layout.unpack(frame)[-1] for frame in frames]


def test_positions_that_jump_are_followed_at_the_joints_own_speed_and_acceleration() -> None:
    stream = Following(1, 1000, speed=20_000, accel=100_000, period_s=0.01)
    stream.aim = 6000
    way = [1000, 1000, *run(stream, 200)]
    steps = [after - before for before, after in itertools.pairwise(way)]
    assert way[-1] == 6000
    assert max(steps) <= 200
    assert max(abs(after - before) for before, after in itertools.pairwise(steps)) <= 12
    assert max(way) <= 6000 + 20


def test_a_smooth_path_is_followed_to_the_count_and_again_after_a_gap() -> None:
    stream = Following(1, 0, speed=20_000, accel=100_000, period_s=0.01)
    way = [round(5 * k * k) for k in range(15)] + [980 + 140 * k for k in range(1, 200)]
    way[80:95] = [way[80]] * 15  # the bus thread was held up: nothing new was due
    reported: list[int] = []
    for stream.aim in way:
        reported += run(stream, 1)
    assert all(abs(a - b) <= 1 for a, b in zip(reported[:80], way[:80], strict=True))
    assert reported[-1] == way[-1]
    steps = [after - before for before, after in itertools.pairwise(reported)]
    assert max(steps) <= 201


@pytest.mark.parametrize(
    ("rate_hz", "period"),
    [(100, (10, -3)), (500, (2, -3)), (400, (25, -4)), (20, (50, -3)), (1000, (1, -3)), (80, (125, -4)), (3, (33, -2))],
)
def test_the_interpolation_period_has_the_format_of_object_60C2(rate_hz: float, period: tuple[int, int]) -> None:
    assert interpolation_period(rate_hz) == period


def test_a_speed_is_slower_the_nearer_the_end_and_zero_behind_it() -> None:
    stream = Turning(1, accel=10**9, period_s=0.01, blind_s=0.3)
    stream.end, stream.fastest = 1000, 500.0
    assert [run(stream, 1, at)[0] for at in (0, 900, 1000)] == [500, pytest.approx(100 / 0.3, rel=0.01), 0]


def test_an_unmeasured_joint_is_assumed_to_follow_its_commands() -> None:
    stream = Turning(1, accel=10**9, period_s=0.01, blind_s=0.3)
    stream.end, stream.fastest = 1000, 500.0
    sample, unpack = Sample(0, 0, 0, 1), table.TURNING.layout.unpack
    reported = [unpack(stream.next(sample, 1 + 10_000_000 * k))[-1] for k in range(400)]
    assert reported[0] == 500
    assert reported == sorted(reported, reverse=True)
    assert sum(reported) * 0.01 == pytest.approx(1000, abs=20)
    later = Sample(0, 0, 0, 5_000_000_000)
    assert unpack(stream.next(later, later.at_ns))[-1] == 500
