"""Every model the driver knows, alone and with others on one line; the driver's bytes are the vendor library's own."""

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig
from trade.errors import ConfigurationError
from trade_drivers import scan
from trade_drivers.vendors.dynamixel import DynamixelDriver
from trade_hil_sim import MODELS, Jam, Servo, WrongModel, instructions

pytestmark = pytest.mark.virtual_time


def plug(rig: Rig, pan: str, tilt: str) -> None:
    """A head with a servo of these models in each joint."""
    rig.configure(
        ("max_speed_rad_s = 2.5", "max_speed_rad_s = 1.0"),
        ('id = 1\nmodel = "XL430-W250"', f'id = 1\nmodel = "{pan}"'),
        ('id = 2\nmodel = "XL430-W250"', f'id = 2\nmodel = "{tilt}"'),
    )
    rig.plug()


@pytest.mark.parametrize("model", MODELS)
def test_each_model_is_attached_and_moved(rig: Rig, model: str) -> None:
    plug(rig, model, model)
    pan = rig.attach().motor("neck.pan")
    assert pan.move_to(0.05) == pytest.approx(0.05, abs=0.01)
    assert rig.truth(1).position_rad == pytest.approx(0.05, abs=0.01)
    assert rig.truth(1).model == model
    assert pan.state().voltage_v == MODELS[model].supply_v


@pytest.mark.parametrize("model", MODELS)
def test_a_model_in_the_place_of_another_is_refused_with_both_names(rig: Rig, model: str) -> None:
    other = "XL330-M288" if model == "XL430-W250" else "XL430-W250"
    plug(rig, other, other)
    rig.sim.do(WrongModel(ids=(1,), number=MODELS[model].number))
    with pytest.raises(ConfigurationError, match=f"is '{other}', but id 1 is {model} "):
        rig.attach()


@pytest.mark.parametrize("model", MODELS)
def test_a_scan_names_each_model(rig: Rig, model: str) -> None:
    rig.plug(Servo(1, MODELS[model]))
    commissioner, port = DynamixelDriver.commissioner(), str(rig.sim.port)

    def named() -> list[tuple[str, str]]:
        return [(one.model, one.problem) for one in scan(commissioner, port, [1_000_000], [1])]

    wait_until(lambda: named() == [(model, "")], "it is named, as soon as this machine answers in time")


@pytest.mark.parametrize("fast", [False, True], ids=["sync", "fast sync"])
def test_servos_with_different_tables_are_read_in_one_exchange(rig: Rig, fast: bool) -> None:
    plug(rig, "XL430-W250", "XL330-M288")
    if fast:
        rig.configure(
            ('driver = "dynamixel"', 'driver = "dynamixel"\nfast_sync = true'),
            ('id = 2\nmodel = "XL430-W250"', 'id = 2\nmodel = "XL330-M288"'),
        )
    group = rig.attach().group("head")
    assert group.move_to([0.1, 0.2]) == pytest.approx([0.1, 0.2], abs=0.03)
    reads = instructions(rig.log, "fast_sync_read" if fast else "sync_read")
    assert {read.ids for read in reads} == {(1, 2)}
    assert [state.voltage_v for state in group.state()] == [12.0, 5.0]


@pytest.mark.parametrize("model", ["XL430-W250", "XH430-W350", "XC330-M288", "XM540-W270"])
def test_the_greatest_effort_is_full_load_for_each_model(rig: Rig, model: str) -> None:
    plug(rig, model, model)
    pan = rig.attach().motor("neck.pan")
    pan.enable()
    rig.sim.do(Jam(ids=(1,)))
    moving = Outcome(lambda: pan.move_to(0.5))
    wait_until(lambda: pan.state().load == 1.0, "it strains")
    pan.relax()
    moving.wait()
