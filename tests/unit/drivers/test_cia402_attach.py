"""Attaching drives: every mistake of wiring, setting and installation is named with what would be right."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import HIP, KNEE, Leg, leg, rig
from trade.errors import ConfigurationError, DeviceAbsent
from trade_drivers import load
from trade_hil_sim import Mute, Unplug
from trade_hil_sim.cia402 import Cia402Bus

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]


def refused(leg: Leg, **options: Any) -> str:
    with pytest.raises(ConfigurationError) as error:
        leg.attach(**options)
    assert not leg.announced
    return str(error.value)


def objects(**values: int) -> Callable[[Cia402Bus], None]:
    """The hip's drive with other values in its dictionary than it was shipped with; a reset would undo them."""

    def change(bus: Cia402Bus) -> None:
        for name, value in values.items():
            next(device for device in bus.devices if device.device_id == HIP).store.set(name, value)  # type: ignore[attr-defined]

    return change


def test_a_drive_that_answers_but_sends_no_heartbeat_is_not_taken_on(leg: Leg) -> None:
    leg.sim.do(Mute(ids=(KNEE,), instruction="heartbeat"))
    text = refused(leg)
    assert 'leg.toml: joint."leg.knee": node 2 answers, but sends no heartbeat (1017h)' in text
    assert not leg.frames("rpdo1")


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"device_type": 0x000F_0191}, "node 1 is no CiA 402 drive: its device type (1000h) names profile 401"),
        ({"supported_modes": 0x3AC}, "it has no profile position mode (6502h)"),
        ({"position_limit_min": -1000}, "is more than the drive's own range (607Dh)"),
        ({"position_limit_min": 5000, "position_limit_max": -5000}, "own range is impossible: 607Dh = 5000 to -5000"),
        ({"position_limit_min": 5000, "position_limit_max": 5000}, "own range is impossible: 607Dh = 5000 to 5000"),
        ({"max_profile_velocity": 1000}, "max_speed_rad_s: 2 is above the drive's own limit 0.03068 (607Fh)"),
    ],
    ids=str,
)
def test_a_setting_that_the_driver_cannot_use_is_named(rig: Leg, values: dict[str, int], complaint: str) -> None:
    rig.plug()
    objects(**values)(rig.sim)
    assert complaint in refused(rig)
    assert not rig.frames("rpdo1")


@pytest.mark.parametrize(("limit", "fits"), [(32_595, True), (32_594, False)])
def test_a_range_may_be_that_of_the_drive_as_rounded_as_it_is_printed(rig: Leg, limit: int, fits: bool) -> None:
    rig.configure(("min_rad = -1.0\nmax_rad = 1.0", "min_rad = -1.000003\nmax_rad = 1.000003"))  # 32 595.03 counts
    rig.plug(prepare=objects(position_limit_min=-limit, position_limit_max=limit))
    if fits:
        assert rig.attach().motor("leg.hip")
    else:
        assert "more than the drive's own range (607Dh)" in refused(rig)


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("counts_per_rev = 4096\ngear = 50\nmin", "gear = 50\nmin", 'joint."leg.hip": missing; a CiA 402 drive'),
        ("id = 2", "id = 127", 'joint."leg.knee".id: 127 is no node of a drive; 1 to 126 are'),
        (
            "max_accel_rad_s2 = 20.0",
            "max_accel_rad_s2 = 1.0",
            "max_accel_rad_s2: a stop from max_speed_rad_s takes",
        ),
        ("gear = 50", "gear = 5e6", "max_rad: the range does not fit into 32 bits"),
        ("gear = 50", "gear = 1e-9", "max_speed_rad_s: 2 is below"),
        ('channel = "can0"', 'channel = "can0"\nrate_hz = 5', "bus.legs.rate_hz: 5 is too slow for watchdog_s"),
        (
            'channel = "can0"',
            'channel = "can0"\nbitrate = 20000',
            "2 drives at 20000 bit/s need 42.2 ms a cycle",
        ),
        ('interface = "socketcan"\nchannel = "can0"', 'port = "/dev/tty"', "driver cia402 needs a CAN bus: interface"),
    ],
)
def test_an_error_in_the_file_is_found_without_a_drive(leg: Leg, before: str, after: str, complaint: str) -> None:
    leg.configure((before, after))
    assert complaint in refused(leg)


def test_a_channel_that_is_not_there_is_named(leg: Leg) -> None:
    leg.sim.do(Unplug())
    text = refused(leg)
    assert "leg.toml: bus.legs.channel" in text
    assert leg.sim.port in text


@pytest.mark.realtime
def test_S20_a_bus_that_has_a_driver_is_not_taken_by_a_second(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    hip.enable()
    mark = written_now()
    moving = Outcome(lambda: hip.move_to(0.3, 0.5))
    leg.wait_for("motion_started", HIP, mark)
    first = len(leg.announced)
    with pytest.raises(ConfigurationError, match=f"another driver has this bus: process {os.getpid()} "):
        leg.attach()
    assert len(leg.announced) == first
    assert not [name for name in ("nmt", "sdo_request") if leg.frames(name, since=mark)]
    assert moving.wait().result == pytest.approx(0.3, abs=0.01)


def test_the_legs_of_the_examples_attach_and_move(rig: Leg) -> None:
    rig.robot = load(Path(__file__).parents[3] / "examples" / "legs.toml")
    rig.plug(paced=True)
    goal = [0.3, 0.6, -0.2, -0.3, 0.4, 0.2]
    assert rig.attach().group("legs").move_to(goal) == pytest.approx(goal, abs=0.01)


def test_on_an_empty_virtual_bus_the_drive_is_absent(rig: Leg) -> None:
    with pytest.raises(DeviceAbsent, match="no drive answers as node 1 on virtual:empty"):
        rig.attach(ports={"legs": "virtual:empty"})
