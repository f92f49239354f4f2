"""What a bus of Feetech servos is refused for, and by which words; nothing is written on the way."""

from pathlib import Path

import pytest

import trade_hil_sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.tail_rig import TailRig, rig
from trade.errors import ConfigurationError
from trade_drivers import load
from trade_hil_sim.feetech import MODELS

pytestmark = pytest.mark.virtual_time

__all__ = ["rig"]

EXAMPLE = Path(__file__).parents[3] / "examples" / "servo_arm.toml"


def refused(rig: TailRig) -> str:
    with pytest.raises(ConfigurationError) as error:
        rig.attach()
    assert not trade_hil_sim.writes(rig.log)
    return str(error.value)


@pytest.mark.parametrize(
    ("address", "data", "complaint"),
    [
        (8, (0,), "status level (register 8) is 0"),
        (33, (1,), "mode (register 33) is 1"),
        (18, (8,), "set bit 2"),
        (18, (28,), "clear bit 4"),
        (18, (13,), "in the other direction by itself, and the file has reversed = "),
        (18, (140,), "clear bits 0 and 7"),
        (9, (0, 0, 0, 0), "many turns"),
        (9, (0, 8, 255, 15), "more than the device's own range"),
    ],
)
def test_a_servo_that_is_set_up_otherwise_is_refused_and_the_register_named(
    rig: TailRig, address: int, data: tuple[int, ...], complaint: str
) -> None:
    rig.plug()
    rig.poke(address, *data)
    assert complaint in (text := refused(rig))
    assert 'joint."tail.root"' in text


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ('driver = "feetech"', 'driver = "feetech"\nfast_sync = false', "no joined answers"),
        ('driver = "feetech"', 'driver = "feetech"\nbaud = 57600\nrate_hz = 50', "57600 is no rate of these servos"),
        ('driver = "feetech"', 'driver = "feetech"\nrate_hz = 5', "too slow"),
        ("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 40.0", "above 38.96, the most an STS3215"),
        ("max_speed_rad_s = 2.5", "max_speed_rad_s = 60.0\n", "takes 3 s"),
        ("max_speed_rad_s = 2.5", "max_speed_rad_s = 0.01", "below 0.0153"),
        ('model = "STS3215"', 'model = "STS9999"', "it supports STS3215"),
        ("id = 1", "id = 1\ngear = 2", "are for other devices"),
    ],
)
def test_errors_of_the_file_alone_are_reported_before_the_port_is_opened(
    rig: TailRig, before: str, after: str, complaint: str
) -> None:
    rig.plug()
    rig.configure((before, after))
    assert complaint in refused(rig)
    assert not trade_hil_sim.received(rig.log)


def test_a_slow_bus_is_refused_a_fast_cycle(rig: TailRig) -> None:
    rig.plug()
    rig.configure(('driver = "feetech"', 'driver = "feetech"\nbaud = 115200\nrate_hz = 250'))
    assert "2 joints at 115200 baud need" in refused(rig)


def test_the_arm_of_the_examples_attaches_and_its_six_joints_arrive_together(rig: TailRig) -> None:
    rig.robot = load(EXAMPLE)
    rig.plug()
    arm = rig.attach(ports={"right_arm": str(rig.sim.port)}).group("right.arm")
    arm.enable()
    goals = [0.3, -0.2, 0.25, 0.1, -0.3, 0.4]
    mark = written_now()
    assert arm.move_to(goals) == pytest.approx(goals, abs=0.03)
    reported = rig.goals(since=mark)
    assert [entry.device_id for entry in reported if entry.t == reported[0].t] == [1, 2, 3, 4, 5, 6]  # in one packet
    wait_until(lambda: all(rig.events("at_rest", i, mark) for i in range(1, 7)), "all joints rest")
    arrived = [rig.events("at_rest", i, mark)[-1].t for i in range(1, 7)]
    started = [rig.events("motion_started", i, mark)[0].t for i in range(1, 7)]
    assert max(arrived) - min(arrived) < 0.3 * (max(arrived) - min(started))


@pytest.mark.parametrize(("model", "other"), [*zip(MODELS, [*MODELS][1:] + [*MODELS][:1], strict=True)])
def test_each_model_is_taken_for_itself_and_for_no_other(rig: TailRig, model: str, other: str) -> None:
    rig.configure(('model = "STS3215"', f'model = "{model}"'))
    rig.plug()
    rig.configure(('model = "STS3215"', f'model = "{other}"'))
    said = refused(rig)
    assert other in said
    assert model in said
    rig.configure(('model = "STS3215"', f'model = "{model}"'))
    assert rig.attach().motor("tail.root").state().fault == ""
