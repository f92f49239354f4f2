"""The programs of docs/drivers.md, run as they stand there, on simulated devices."""

from collections.abc import Iterator
from functools import reduce
from pathlib import Path

import pytest
import serial

import trade
from tests.docs.blocks import DOCS, ROOT, of, said, sections
from tests.docs.conftest import Play
from tests.support.c_compiler import library
from tests.system.conftest import ROSIES_HEAD, at_ports
from trade import where
from trade_drivers import JointGroup, Measured, PolledSensor, SensorInfo, attach, load
from trade_hil_sim import SimProcess, events

PAGE = "drivers.md"


def test_every_program_of_the_page_is_run() -> None:
    assert sections(iter([DOCS / PAGE]), "python") == said(globals())


@pytest.fixture
def sim(tmp_path: Path) -> Iterator[SimProcess]:
    """The simulated head; ``examples/head.toml`` of the folder that the test is in has its port."""
    (tmp_path / "examples").mkdir()
    with SimProcess(ROSIES_HEAD) as running:
        at_ports(ROSIES_HEAD, running, tmp_path / "examples")
        yield running


def rests_rad(sim: SimProcess, joint: str) -> list[float]:
    """Where a joint has come to rest, by the simulator's log."""
    return [round(one.position_rad or 0.0, 2) for one in events(sim.entries(), "at_rest") if one.joint == joint]


@pytest.mark.slow
@of(PAGE, "Drivers")
def test_a_robot_is_attached_and_moved(sim: SimProcess, play: Play) -> None:
    play.run()
    assert rests_rad(sim, "neck.pan") == pytest.approx([0.3, 0.0], abs=0.02)
    assert rests_rad(sim, "neck.tilt") == pytest.approx([0.2], abs=0.02)


@pytest.mark.slow
@of(PAGE, "Trajectories")
def test_a_trajectory_is_followed(sim: SimProcess, play: Play) -> None:
    with attach(load("examples/head.toml")) as rosie:
        head: JointGroup = rosie.group("head")
        head.move_to([0.0, 0.0])
        play.run(head=head)
    assert rests_rad(sim, "neck.tilt")[-1] == pytest.approx(0.0, abs=0.03)


@of(PAGE, "A C library")
def test_a_c_library_is_a_provider(play: Play, tmp_path: Path) -> None:
    library(ROOT / "examples" / "c_gripper" / "gripper.c", tmp_path / "libgripper.so")
    play.run()
    gripper = play.module.Gripper(str(tmp_path / "port"))
    trade.register(gripper, "rosie.hand")
    trade.call(where(name="move_to", group="rosie.hand"), 0.08)
    assert (tmp_path / "port").read_text().splitlines()[-1] == "0.080000"
    assert len(trade.call(where(name="forces_n"))) == 2
    trade.call(where(name="stop", group="rosie.hand"))
    trade.deregister(gripper)
    gripper.close()


@of(PAGE, "In an afternoon: a sensor as a plug-in")
def test_the_sensor_is_that_of_the_example(play: Play) -> None:
    """Which tests/unit/drivers/test_plugin.py proves on its simulator."""
    [block] = play.left
    assert block.text in (ROOT / "examples/plugin/src/acme_thermo/driver.py").read_text(encoding="utf-8")
    play.run(PolledSensor=PolledSensor, SensorInfo=SensorInfo, Measured=Measured, serial=serial, reduce=reduce)
    assert play.module.Thermo("kitchen.oven", "nowhere", 2).info().size == 2
