"""Buses with devices as they leave the factory: all of one id, which no robot file can describe."""

from pathlib import Path

import pytest

from trade_hil_sim import Absent, SimulationError
from trade_hil_sim.cia402 import Cia402Bus, Drive
from trade_hil_sim.dynamixel import DynamixelBus
from trade_hil_sim.feetech import FeetechBus
from trade_hil_sim.robot._factory_devices import fresh_bus
from trade_hil_sim.robotiq import RobotiqBus

pytestmark = pytest.mark.virtual_time


@pytest.mark.parametrize(
    ("words", "kind", "ids", "baud"),
    [
        ("neck=dynamixel:XL430-W250,XM430-W350", DynamixelBus, [1, 1], 57_600),
        ("tail=feetech:STS3215", FeetechBus, [1], 1_000_000),
        ("hand=robotiq:2F-85", RobotiqBus, [9], 115_200),
    ],
)
def test_devices_have_the_id_and_the_rate_they_leave_the_factory_with(
    words: str, kind: type, ids: list[int], baud: int, tmp_path: Path
) -> None:
    bus = fresh_bus(words, tmp_path)
    assert isinstance(bus, kind)
    assert [(one.device_id, one.baud) for one in bus.devices] == [(one, baud) for one in ids]
    assert bus.port == tmp_path / words.partition("=")[0]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("neck", "write NAME=DRIVER:MODEL"),
        ("neck=dynamixel", "write NAME=DRIVER:MODEL"),
        ("legs=cia402:ACME", "no driver 'cia402' here"),
        ("neck=dynamixel:AX-12A", "not simulated"),
    ],
)
def test_other_words_are_refused_with_what_would_be_right(words: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match=complaint):
        fresh_bus(words, tmp_path)


def test_one_of_two_of_one_id_is_unplugged_by_its_number(tmp_path: Path) -> None:
    bus = fresh_bus("neck=dynamixel:XL430-W250,XL430-W250", tmp_path)
    bus.do(Absent(nth=2))
    assert [one.absent for one in bus.devices] == [False, True]
    bus.do(Absent(nth=2, on=False))
    assert [one.absent for one in bus.devices] == [False, False]
    with pytest.raises(SimulationError, match="has 2 devices, no number 3"):
        bus.do(Absent(nth=3))


def test_where_ids_are_unique_there_is_no_number(tmp_path: Path) -> None:
    with Cia402Bus([Drive(1)]) as bus, pytest.raises(SimulationError, match="not by nth"):
        bus.do(Absent(nth=1))
