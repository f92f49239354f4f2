"""S23 for CiA 402 drives: scale and units are what the drive says, or it is refused before anything is sent."""

import re
import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.legs import (
    COUNTS_PER_RAD,
    CYCLIC_POSITION,
    CYCLIC_VELOCITY,
    HIP,
    PROFILE_VELOCITY,
    Leg,
    fault_of,
    leg,
    only,
    rig,
    turned_by_another,
)
from tests.unit.drivers.test_cia402_motor import through
from trade.errors import ConfigurationError, DeviceFault, TradeError
from trade_drivers import Tolerances
from trade_drivers.vendors.cia402._homing import Drive
from trade_hil_sim import Absent, BrownOut, LogEntry, Place, Replug, Unplug
from trade_hil_sim.cia402 import Object, factor_objects, unit_objects

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]

RPM, MILLI_RPM, RAD_S, DEG_S, INC_S = 0x00B44700, 0xFDB44700, 0x00100300, 0x00410300, 0x00B50300
RPM_S, RAD_S2, DEG_S2, REV_S2, REV_MIN_S = 0x00C00300, 0x00105700, 0x00410300, 0x00B40300, 0x00B44703
SLOWER = (("max_speed_rad_s = 2.0", "max_speed_rad_s = 1.5"), ("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 10.0"))
RAMPS = ("profile_velocity", "profile_acceleration", "profile_deceleration", "quick_stop_deceleration")


def plug(rig: Leg, *objects: Object, **values: int) -> Any:
    """Plug in a leg whose hip's drive has these objects and values, too."""

    def prepare(bus: Any) -> None:
        hip = next(device for device in bus.devices if device.device_id == HIP)
        hip.says(*objects)
        for name, value in values.items():
            hip.store.set(name, value)

    rig.plug(prepare=prepare)
    return rig.drive(HIP)


def commands(leg: Leg, since: float = 0.0) -> list[LogEntry]:
    """All that has been written to the hip's drive, by frames and in its dictionary."""
    writes = [entry for entry in leg.frames("sdo_request", HIP, since) if entry.data[0] & 0xE0 == 0x20]
    return [entry for name in ("rpdo1", "rpdo2", "rpdo3", "rpdo4") for entry in leg.frames(name, HIP, since)] + writes


def outcome(act: Callable[[], object]) -> str:
    """What an act ends with: nothing, or its error in words."""
    try:
        act()
    except TradeError as error:
        return str(error)
    return ""


def refused(leg: Leg) -> str:
    with pytest.raises(ConfigurationError) as error:
        leg.attach()
    assert not commands(leg)
    assert not leg.announced
    assert not leg.truth(HIP).torque
    return str(error.value)


@pytest.mark.parametrize(
    ("objects", "ramps"),
    [
        ([], (48892, 325949)),
        (unit_objects(position=0x00B50000, velocity=RPM, acceleration=RPM_S), (716, 4774)),
        (unit_objects(velocity=MILLI_RPM, acceleration=REV_MIN_S), (716197, 4774)),
        (unit_objects(velocity=RAD_S, acceleration=RAD_S2), (75, 500)),
        (unit_objects(velocity=DEG_S, acceleration=REV_S2), (4297, 79)),
        (unit_objects(velocity=INC_S, acceleration=INC_S), (48892, 325949)),
        (unit_objects(position=0x00B50000), (48892, 325949)),
    ],
    ids=["none", "rpm", "milli-rpm", "rad", "deg", "inc", "position"],
)
def test_S23_speeds_and_accelerations_are_written_in_the_drives_own_units(
    rig: Leg, objects: list[Object], ramps: tuple[int, int]
) -> None:
    rig.configure(*SLOWER)
    hip = plug(rig, *objects)
    motor = rig.attach().motor("leg.hip")
    motor.enable()
    speed, accel = ramps
    assert [hip.store.get(name) for name in RAMPS] == [speed, accel, accel, accel]
    mark = written_now()
    assert motor.move_to(0.6) == pytest.approx(0.6, abs=0.01)
    assert rig.truth(HIP).position_rad == pytest.approx(0.6, abs=0.01)
    took_s = rig.wait_for("at_rest", HIP, mark).t - rig.wait_for("motion_started", HIP, mark).t
    assert took_s == pytest.approx(0.6 / 1.5 + 1.5 / 10, rel=0.03)  # whatever the unit


@pytest.mark.parametrize(("limit_rpm", "complaint"), [(50_000, ""), (900, "2 is above the drive's own limit 1.885")])
def test_S23_the_drives_greatest_speed_is_read_in_its_own_unit(rig: Leg, limit_rpm: int, complaint: str) -> None:
    plug(rig, *unit_objects(velocity=RPM, acceleration=RPM_S), max_profile_velocity=limit_rpm)
    if complaint:
        assert complaint in refused(rig)
    else:
        assert rig.attach().motor("leg.hip").move_to(0.1) == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(
    ("objects", "complaint"),
    [
        (unit_objects(velocity=0x00014700, acceleration=RPM_S), "its unit m/min (60A9h = 00014700h) cannot be conv"),
        (unit_objects(velocity=0xFD7B0300, acceleration=RPM_S), "its unit 10^-3 unit 7Bh/s (60A9h = FD7B0300h) cann"),
        (unit_objects(velocity=RPM, acceleration=RPM), "its unit rev/min (60AAh = 00B44700h) cannot be converted"),
        (unit_objects(velocity=0, acceleration=0), "its unit no unit (60A9h = 00000000h) cannot be converted"),
        (unit_objects(position=0xFA010000), "its unit 10^-6 m (60A8h = FA010000h) cannot be converted to an angle"),
        (unit_objects(velocity=RPM), "it has a unit of its own in 60A9h, but no 60AAh"),
        (unit_objects(acceleration=RPM_S), "it has a unit of its own in 60AAh, but no 60A9h"),
        (unit_objects(velocity=RPM, acceleration=RPM_S, access="wo"), "it refuses to be read: 60A9h"),
        (unit_objects(position=0x00B50000, access="wo"), "it refuses to be read: 60A8h"),
        ([Object(0x60A9, 0, "short", "u16", "ro", 0x4700)], "refuses to be read: 60A9h: it came with 2 bytes, not 4"),
        (unit_objects(velocity=0x7FB44700, acceleration=RPM_S), "max_speed_rad_s: 2 is below"),
        (unit_objects(velocity=0x81B44700, acceleration=RPM_S), "does not fit into 32 bits of the drive's own unit"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_S23_a_unit_that_cannot_be_converted_is_refused_with_its_name(
    rig: Leg, objects: list[Object], complaint: str
) -> None:
    plug(rig, *objects)
    assert complaint in refused(rig)


@pytest.mark.parametrize(("objects", "speed"), [([], 16297), (unit_objects(velocity=RPM, acceleration=RPM_S), 239)])
def test_S23_a_drive_found_turning_is_halted_whatever_its_unit(rig: Leg, objects: list[Object], speed: int) -> None:
    plug(rig, *objects)
    started = turned_by_another(rig, speed)  # 0.5 rad/s
    robot = rig.attach()
    rig.wait_for("at_rest", HIP, started.t)
    assert bytes.fromhex("2b4060000f010000") in [e.data for e in rig.frames("sdo_request", HIP, started.t)]
    assert robot.motor("leg.hip").state().enabled


@pytest.mark.parametrize("mode", [CYCLIC_VELOCITY, PROFILE_VELOCITY])
@pytest.mark.parametrize("objects", [[], unit_objects(velocity=RPM, acceleration=RPM_S)], ids=["counts", "rpm"])
def test_S23_a_speed_is_the_same_in_every_unit_and_ends_within_the_range(
    rig: Leg, mode: int, objects: list[Object]
) -> None:
    plug(rig, *objects)
    only(1, mode)(rig.sim)
    motor = rig.attach().motor("leg.hip")
    motor.enable()
    mark, fastest = written_now(), 0.0
    for _ in range(500):
        if rig.events("at_rest", HIP, mark):
            break
        motor.set_velocity(0.5, 0.2)
        state = motor.state()
        fastest = max(fastest, state.velocity_rad_s)
        wait_until(lambda: motor.state().measured_at > state.measured_at, "it is measured")  # noqa: B023 - at once
    assert fastest == pytest.approx(0.5, abs=0.005)
    assert 0.95 < rig.truth(HIP).position_rad <= 1.0


@pytest.mark.parametrize("objects", [[], unit_objects(velocity=RPM, acceleration=RPM_S)], ids=["counts", "rpm"])
def test_S23_cyclic_positions_are_the_same_in_every_unit(rig: Leg, objects: list[Object]) -> None:
    plug(rig, *objects)
    only(1, CYCLIC_POSITION)(rig.sim)
    group = rig.attach().group("leg")
    way = through(group, (0.0, [0.0, 0.0]), (0.6, [0.5, 0.0]), (1.0, [0.5, 0.0]))
    assert group.follow(way, Tolerances(path_rad=0.05))[0] == pytest.approx(0.5, abs=0.005)
    assert rig.frames("rpdo4", HIP)
    assert rig.truth(HIP).position_rad == pytest.approx(0.5, abs=0.005)


@pytest.mark.parametrize("objects", [[], unit_objects(velocity=RPM, acceleration=RPM_S)], ids=["counts", "rpm"])
def test_S23_a_homing_is_as_fast_in_every_unit(rig: Leg, objects: list[Object]) -> None:
    drive = plug(rig, *objects)
    motor = rig.attach().motor("leg.hip")
    assert isinstance(motor, Drive)
    motor.home(35, speed_rad_s=1.0)
    rates = [drive.store.rate(name) for name in ("homing_switch_speed", "homing_acceleration")]
    assert rates == pytest.approx([COUNTS_PER_RAD, 20 * COUNTS_PER_RAD], rel=0.01)


@pytest.mark.parametrize(
    "objects",
    [
        [],
        factor_objects(encoder=(4096, 1)),
        factor_objects(encoder=(8192, 2)),
        [Object(0x607E, 0, "polarity", "u8", "rw", 0x3F)],
        factor_objects(encoder=(131072, 1), gear_ratio=(1, 1), feed=(4096, 1)),
        factor_objects(encoder=(131072, 1), gear_ratio=(3, 1), feed=(12288, 1)),
        [*factor_objects(encoder=(4096, 1)), *unit_objects(position=0x00B50000)],
        [*factor_objects(encoder=(40960, 1)), *unit_objects(position=0x01B50000)],
    ],
    ids=["none", "encoder", "two turns", "no polarity", "feed", "gear", "increments", "tens"],
)
def test_S23_a_scale_that_is_the_files_is_accepted(rig: Leg, objects: list[Object]) -> None:
    plug(rig, *objects)
    assert rig.attach().motor("leg.hip").move_to(0.3) == pytest.approx(0.3, abs=0.01)
    assert rig.truth(HIP).position_rad == pytest.approx(0.3, abs=0.01)


def test_S23_counts_of_an_angle_need_no_encoder(rig: Leg) -> None:
    rig.configure(("counts_per_rev = 4096\ngear = 50", "counts_per_rev = 360000\ngear = 1"))
    plug(rig, *unit_objects(position=0xFD410000), *factor_objects(encoder=(131072, 1), feed=(1, 1)))
    assert rig.attach().motor("leg.hip").move_to(0.3) == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize(
    ("objects", "complaint"),
    [
        (
            factor_objects(encoder=(16384, 1)),
            "4096 counts for a turn of the motor, the drive 16384 (608Fh = 16384/1)",
        ),
        (factor_objects(encoder=(1024, 1)), "4096 counts for a turn of the motor, the drive 1024 (608Fh = 1024/1)"),
        (
            factor_objects(encoder=(4096, 1), feed=(1, 1)),
            "4096 counts for a turn of the motor, the drive 1 (6092h = 1/1)",
        ),
        (
            factor_objects(encoder=(4096, 1), gear_ratio=(2, 1), feed=(4096, 1)),
            "4096 counts for a turn of the motor, the drive 2048 (6092h = 4096/1, 6091h = 2/1)",
        ),
        (unit_objects(position=0xFD410000), "the drive 360000 (60A8h = FD410000h)"),
        (factor_objects(encoder=(4096, 0)), "its scale is impossible: 608Fh = 4096/0"),
        (factor_objects(encoder=(0, 1)), "its scale is impossible: 608Fh = 0/1"),
        (factor_objects(encoder=(4096, 1), gear_ratio=(1, 0)), "its scale is impossible: 6091h = 1/0"),
        (
            factor_objects(encoder=(4096, 1), gear_ratio=(2, 1)),
            "its scale is unknown: it has 6091h = 2/1 and",
        ),
        ([Object(0x608F, 1, "encoder_1", "u32", "wo", 4096)], "it refuses to be read: 608Fh:1"),
        ([Object(0x608F, 1, "encoder_1", "u32", "ro", 4096)], "its scale is impossible: 608Fh = 4096/0"),
        (
            [Object(0x607E, 0, "polarity", "u8", "rw", 0x80)],
            "(607Eh) is 80h: it counts in the other direction by itself",
        ),
        (
            [Object(0x607E, 0, "polarity", "u8", "rw", 0x40)],
            "(607Eh) is 40h: it counts in the other direction by itself",
        ),
        (unit_objects(position=0x7F100000), "4096 counts for a turn of the motor, the drive 6.28"),
        (unit_objects(position=0x80B40000), "4096 counts for a turn of the motor, the drive 1e+128"),
        (unit_objects(velocity=0x7FB44700, acceleration=RPM_S), "below"),
        (unit_objects(velocity=0x80B44700, acceleration=RPM_S), "does not fit into 32 bits"),
        (unit_objects(velocity=0xFFFFFFFF, acceleration=RPM_S), "cannot be converted to rad/s"),
        (unit_objects(velocity=0, acceleration=RPM_S), "its unit no unit (60A9h = 00000000h) cannot be converted"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_S23_another_scale_than_the_files_is_refused_with_both_numbers(
    rig: Leg, objects: list[Object], complaint: str
) -> None:
    plug(rig, *objects)
    assert complaint in refused(rig)


@pytest.mark.parametrize(
    ("objects", "complaint"),
    [
        (factor_objects(encoder=(16384, 1)), "4096 counts for a turn of the motor, the drive 16384"),
        (unit_objects(velocity=0x00014700, acceleration=RPM_S), "its unit m/min"),
    ],
    ids=["scale", "unit"],
)
@pytest.mark.parametrize(
    ("loss", "end"),
    [
        (Absent(ids=(HIP,)), Absent(ids=(HIP,), on=False)),
        (Unplug(), Replug()),
    ],
    ids=["cable", "port"],
)
def test_S23_a_drive_that_says_something_else_after_a_loss_is_not_commanded(
    rig: Leg, loss: Any, end: Any, objects: list[Object], complaint: str
) -> None:
    drive = plug(rig)
    motor = rig.attach().motor("leg.hip")
    motor.move_to(0.3)
    drive.says(*objects)
    rig.sim.do(loss)
    wait_until(lambda: outcome(motor.state), "it is noticed")
    mark = written_now()
    rig.sim.do(end)
    wait_until(lambda: complaint in outcome(motor.state), "it is compared again")
    for act in (motor.enable, lambda: motor.move_to(0.1), lambda: motor.set_velocity(0.1)):
        with pytest.raises(DeviceFault, match=complaint):
            act()
    assert not commands(rig, mark)
    assert not rig.events("motion_started", HIP, mark)
    assert not rig.events("torque_on", HIP, mark)


def test_S23_units_that_a_loss_of_power_has_changed_are_used_from_then_on(rig: Leg) -> None:
    rig.configure(*SLOWER)
    drive = plug(rig)
    motor = rig.attach().motor("leg.hip")
    motor.move_to(0.3)
    drive.says(*unit_objects(velocity=RPM, acceleration=RPM_S))
    rig.sim.do(BrownOut(ids=(HIP,)))
    wait_until(lambda: "it has restarted" in fault_of(motor), "it is back")
    motor.enable()
    assert [drive.store.get(name) for name in RAMPS] == [716, 4774, 4774, 4774]
    assert motor.move_to(0.1) == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(("limit", "at"), [("position_limit_max", 42_373), ("position_limit_min", -42_373)])
def test_S23_a_drive_beyond_its_own_range_is_not_enabled(rig: Leg, limit: str, at: int) -> None:
    drive = plug(rig, position_limit_min=-33_247, position_limit_max=33_247)
    only(1, CYCLIC_POSITION)(rig.sim)
    rig.sim.do(Place(ids=(HIP,), counts=at))
    robot = rig.attach()
    motor, group = robot.motor("leg.hip"), robot.group("leg")
    place, end = drive.joint_rad(time.monotonic()), at / abs(at) * 1.02
    complaint = f"it is at {place:.3f} rad, outside its own range, which ends at {end:.3f} rad (607Dh)"
    mark = written_now()
    for act in (
        motor.enable,
        lambda: motor.move_to(0.5),
        lambda: motor.set_velocity(-0.1 if at > 0 else 0.1),
        group.enable,
    ):
        with pytest.raises(DeviceFault, match=re.escape(complaint)):
            act()
    assert not commands(rig, mark)
    assert not rig.truth(HIP).torque
    assert rig.truth(HIP).position_counts == at
    rig.sim.do(Place(ids=(HIP,), counts=33_250 * at // abs(at)))  # its own end, as nearly as it can hold
    wait_until(lambda: abs(motor.state().position_rad) < 1.03, "it was turned by hand")
    motor.enable()
    assert motor.move_to(0.5) == pytest.approx(0.5, abs=0.01)
