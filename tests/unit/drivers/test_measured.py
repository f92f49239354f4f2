"""What drivers tell metrics of buses and joints: numbers that are known already."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from trade_drivers import attach, load
from trade_hil_sim import SimProcess

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("robot", "bus", "device"),
    [("head.toml", "rosie.neck", "rosie.neck.pan"), ("legs.toml", "rosie.legs", None)],
)
def test_a_bus_counts_its_cycles_and_its_joints_say_how_warm_they_are(
    robot: str, bus: str, device: str | None, start_container: Callable[..., object]
) -> None:
    file = ROOT / "examples" / robot
    with (
        SimProcess(file) as sim,
        attach(load(file), announced=False, ports=sim.ports) as attached,
    ):

        def found() -> dict[tuple[str, ...], float]:
            return {(one.name, *one.labels.values()): one.value for one in attached.measures()}

        before = found()["bus_cycles", bus]
        wait_until(lambda: found()["bus_cycles", bus] > before + 5)
        now = found()
        assert now["bus_up", bus] == 1
        assert {("bus_late_cycles", bus), ("bus_missed_answers", bus)} <= now.keys()
        if device is not None:
            assert now["device_up", device] == 1
            assert 0 < now["device_temperature_celsius", device] < 100
        else:
            assert any(key[0] == "can_load_ratio" for key in now)
