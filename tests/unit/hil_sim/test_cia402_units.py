"""What a simulated drive may say about its units and scale, and when it takes a mapping."""

import pytest

from tests.unit.hil_sim.drive_bench import NODE, Bench, enabled
from trade_hil_sim.cia402 import Mode, factor_objects, unit_objects

RPM, RPM_S = 0x00B44700, 0x00C00300


def test_without_units_speeds_are_counts_and_the_objects_do_not_exist() -> None:
    bench = enabled(Mode.PROFILE_VELOCITY)
    assert bench.sdo("40a9600000000000") == "80a9600000000206"
    assert bench.sdo("408f600100000000") == "808f600100000206"
    bench.put(0x60FF, 4096, 4)
    bench.run(1.5)
    before = bench.position
    bench.run(1.0)
    assert bench.position - before == pytest.approx(4096, abs=2)


@pytest.mark.parametrize(
    ("unit", "value", "counts_s"),
    [(RPM, 60, 4096), (0xFEB44700, 6000, 4096), (0x00100300, 2, 1304), (0x00410300, 90, 1024), (0x00B50300, 300, 300)],
    ids=["rpm", "hundredths", "rad", "deg", "increments"],
)
def test_a_speed_is_what_its_unit_says(unit: int, value: int, counts_s: int) -> None:
    bench = Bench()
    bench.drive.says(*unit_objects(velocity=unit, acceleration=RPM_S))
    bench.enable(Mode.PROFILE_VELOCITY)
    bench.put(0x60FF, value, 4)
    bench.run(1.0)
    before = bench.position
    bench.run(1.0)
    assert bench.position - before == pytest.approx(counts_s, abs=2)
    assert bench.velocity == value


def test_a_ramp_is_what_its_unit_says() -> None:
    bench = Bench()
    bench.drive.says(*unit_objects(velocity=RPM, acceleration=RPM_S))
    bench.enable(Mode.PROFILE_VELOCITY)
    bench.put(0x6083, 30, 4)
    bench.put(0x60FF, 60, 4)
    assert bench.until(lambda: bench.velocity == 60, within_s=3) == pytest.approx(2, abs=0.05)


def test_what_it_says_outlasts_a_loss_of_power_and_may_be_unreadable() -> None:
    bench = Bench()
    bench.drive.says(*factor_objects(encoder=(16384, 1)), *unit_objects(velocity=RPM, access="wo"))
    bench.drive.brown_out(bench.t)
    bench.run(0.1)
    assert [bench.get(0x608F, sub) for sub in (1, 2)] == [16384, 1]
    assert bench.sdo("40a9600000000000") == "80a9600001000106"


def test_a_strict_drive_takes_a_mapping_only_while_pre_operational() -> None:
    bench = Bench()
    bench.drive.node.map_only_pre_operational()
    disabled = 0x8000_0180 | NODE
    bench.hear(0x000, bytes((1, NODE)))
    assert bench.try_put(0x1800, disabled, 4, 1) == 0x0800_0022
    bench.hear(0x000, bytes((0x80, NODE)))
    assert bench.try_put(0x1800, disabled, 4, 1) == 0
