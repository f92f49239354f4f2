"""A joint's range in the robot file may be the range that is set in its device, as rounded as files are."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.unit.drivers.conftest import Rig
from tests.unit.drivers.tail_rig import TailRig
from trade.errors import ConfigurationError
from trade_hil_sim import events, motion_writes, writes

pytestmark = pytest.mark.virtual_time

LOW, HIGH = 746, 3477
"""What a calibration of LeRobot has set in a servo."""
LOW_RAD, HIGH_RAD = -1.99724, 2.19206
"""The same in rad, with the six digits that a refusal prints; both ends are up to half a count outside."""
COUNT_RAD = 0.001534
RIGS = {
    "dynamixel": (Rig, "neck.pan", ("min_position_limit", "max_position_limit"), 1.4),
    "feetech": (TailRig, "tail.root", ("min_angle", "max_angle"), 1.4),
}


@pytest.fixture(params=RIGS)
def limited(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[[float, float], Any]]:
    """Plugs in a servo with a range of its own, for a robot file with another one."""
    made, name, registers, end = RIGS[request.param]
    with ExitStack() as undo:
        rig: Any = made(tmp_path, undo)

        def plug(low_rad: float, high_rad: float) -> Any:
            rig.configure((f"min_rad = {-end}\nmax_rad = {end}", f"min_rad = {low_rad}\nmax_rad = {high_rad}"))
            rig.plug()
            memory = rig.sim.devices[0].memory
            for register, value in zip(registers, (LOW, HIGH), strict=True):
                memory.set(register, value)
                memory.keep(register)
            rig.joint = name
            return rig

        yield plug


def test_a_range_equal_to_the_devices_own_works_up_to_both_ends(limited: Callable[[float, float], Any]) -> None:
    rig = limited(LOW_RAD, HIGH_RAD)
    motor = rig.attach().motor(rig.joint)
    motor.enable()
    for goal, count in ((HIGH_RAD, HIGH), (LOW_RAD, LOW)):
        motor.move_to(goal)
        assert events(rig.log, "at_rest", device_id=1)[-1].position_counts == count
        [*_, last] = writes(rig.log, device_id=1, register="goal_position")
        assert count.to_bytes(2, "little").hex() in last.hex


@pytest.mark.parametrize("beyond", [(LOW_RAD - COUNT_RAD, HIGH_RAD), (LOW_RAD, HIGH_RAD + COUNT_RAD)])
def test_a_range_that_is_one_count_wider_is_refused(
    limited: Callable[[float, float], Any], beyond: tuple[float, float]
) -> None:
    rig = limited(*beyond)
    with pytest.raises(ConfigurationError, match="more than the device's own range"):
        rig.attach()
    assert not motion_writes(rig.log)


@pytest.mark.parametrize(("high_rad", "fits"), [(3.1402, True), (3.1416, False)])
def test_a_range_of_a_whole_turn_may_be_rounded_as_well(
    limited: Callable[[float, float], Any], high_rad: float, fits: bool
) -> None:
    rig = limited(-3.1416, high_rad)  # 0 and 4095 are -3.14159 and 3.14006 rad
    with pytest.raises(ConfigurationError) as refusal:
        rig.attach()
    assert ("more than the device's own range" if fits else "is outside the range of an") in str(refusal.value)
    assert not motion_writes(rig.log)
