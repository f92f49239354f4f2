"""What a simulated camera draws: pure pictures of what devices do."""

from math import pi

import pytest

from trade_hil_sim import ArmTruth, BusState, DeviceState, GripperTruth
from trade_hil_sim.scene import BACKGROUND, LIMB, OBJECT, Field, draw, fields, png

pytestmark = pytest.mark.virtual_time

WIDE, HIGH = 120, 80


def joint(name: str, angle_rad: float) -> DeviceState:
    return DeviceState(
        device_id=1,
        joint=name,
        model="",
        position_counts=0,
        position_rad=angle_rad,
        velocity_rad_s=0.0,
        goal_counts=0,
        torque=False,
        moving=False,
        operating_mode=3,
        hardware_error=0,
        watchdog=0,
        absent=False,
    )


def hand(width_m: float, object_m: float | None = None, *, holding: bool = False) -> GripperTruth:
    return GripperTruth(
        device_id=9,
        gripper="hand",
        width_m=width_m,
        position_counts=0,
        goal_counts=0,
        activated=True,
        moving=False,
        holding=holding,
        object_m=object_m,
        force_n=0.0,
        fault=0,
        absent=False,
    )


def bus(*devices: DeviceState | GripperTruth) -> list[BusState]:
    joints = [device for device in devices if isinstance(device, DeviceState)]
    grippers = [device for device in devices if isinstance(device, GripperTruth)]
    return [BusState(name="b", port="", plugged=True, devices=joints, grippers=grippers)]


def pixels(
    buses: list[BusState], colour: tuple[int, int, int], wide: int = WIDE, high: int = HIGH
) -> set[tuple[int, int]]:
    rgb = draw(buses, wide, high)
    assert len(rgb) == 3 * wide * high
    return {(at % wide, at // wide) for at in range(wide * high) if tuple(rgb[3 * at : 3 * at + 3]) == colour}


def test_a_limb_points_where_its_joint_does() -> None:
    ends = {angle: pixels(bus(joint("pan", angle)), LIMB) for angle in (0.0, pi / 2, pi, -pi / 2)}
    middle_x, middle_y = WIDE // 2, HIGH // 2
    reach = HIGH // 4
    assert any(x > middle_x + reach for x, _ in ends[0.0])
    assert any(y < middle_y - reach for _, y in ends[pi / 2]), "counter-clockwise, and rows count downwards"
    assert any(x < middle_x - reach for x, _ in ends[pi])
    assert any(y > middle_y + reach for _, y in ends[-pi / 2])
    assert len(set(map(frozenset, ends.values()))) == len(ends)


def test_a_small_move_is_seen() -> None:
    assert pixels(bus(joint("pan", 0.0)), LIMB) != pixels(bus(joint("pan", 0.1)), LIMB)


def test_fields_do_not_overlap_and_what_is_drawn_stays_in_them() -> None:
    names = [f"j{number}" for number in range(7)]
    for seen in names:
        places = fields(bus(*(joint(name, 0.0) for name in names)), WIDE, HIGH)
        one = pixels(bus(*(joint(name, pi / 4 if name == seen else 0.0) for name in names)), LIMB)
        none = pixels(bus(*(joint(name, 0.0) for name in names)), LIMB)
        changed = one ^ none
        assert changed
        assert all(_is_in(places[seen], pixel) for pixel in changed)
    areas = sum(field.width * field.height for field in places.values())
    assert areas <= WIDE * HIGH


def test_fingers_are_as_far_apart_as_they_are_and_an_object_is_between_them() -> None:
    gaps = []
    for width_m in (0.02, 0.04, 0.08):
        columns = {x for x, _ in pixels(bus(hand(width_m)), LIMB)}
        gaps.append(min(x for x in columns if x >= WIDE // 2) - max(x for x in columns if x < WIDE // 2))
    assert gaps == sorted(set(gaps))
    assert gaps[2] / gaps[0] == pytest.approx(4, rel=0.2)
    assert not pixels(bus(hand(0.08)), OBJECT)
    loose, held = pixels(bus(hand(0.08, 0.04)), OBJECT), pixels(bus(hand(0.038, 0.04, holding=True)), OBJECT)
    assert loose
    assert _is_between(held, pixels(bus(hand(0.038, 0.04, holding=True)), LIMB))


def test_each_joint_of_an_arm_has_a_field() -> None:
    arm = ArmTruth(
        device_id=0,
        arm="right",
        model="UR5e",
        positions_rad=[0.0] * 6,
        velocities_rad_s=[0.0] * 6,
        pose=[0.0] * 6,
        moving=False,
        robot_mode="",
        safety_mode="",
        program="",
        freedrive=False,
        speed_fraction=1.0,
        watchdog_hz=0.0,
        absent=False,
    )
    state = [BusState(name="ur", port="", plugged=True, arms=[arm])]
    assert list(fields(state, WIDE, HIGH)) == [f"right.{number}" for number in range(6)]
    assert pixels(state, LIMB)


def test_without_anything_to_see_there_is_a_picture_all_the_same() -> None:
    assert {draw([], 4, 3)[at] for at in range(3)} == set(BACKGROUND)
    assert fields([], 4, 3) == {}


@pytest.mark.parametrize(("wide", "high"), [(1, 1), (2, 50), (50, 2)])
def test_small_pictures_can_be_drawn(wide: int, high: int) -> None:
    assert len(draw(bus(joint("pan", 1.0), hand(0.1, 0.05)), wide, high)) == 3 * wide * high


def test_pixels_that_are_too_few_are_no_picture() -> None:
    with pytest.raises(ValueError, match="11 bytes are not 2 x 2 pixels"):
        png(bytes(11), 2, 2)


def _is_in(field: Field, pixel: tuple[int, int]) -> bool:
    x, y = pixel
    return field.left <= x < field.left + field.width and field.top <= y < field.top + field.height


def _is_between(inner: set[tuple[int, int]], outer: set[tuple[int, int]]) -> bool:
    xs = [x for x, _ in outer]
    return bool(inner) and min(xs) < min(x for x, _ in inner) <= max(x for x, _ in inner) < max(xs)
