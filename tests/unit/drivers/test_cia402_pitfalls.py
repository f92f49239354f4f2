"""What is known to go wrong with drives and CANopen libraries, and does not here; the table is in docs/drivers.md."""

import threading
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import COUNTS_PER_RAD, HIP, KNEE, Leg, fault_of, leg, rig
from trade.errors import ConfigurationError, DeviceFault
from trade_hil_sim import Echo, Emergency, Mute, Truncate
from trade_hil_sim.cia402 import Abort, AbortCode, Cia402Bus

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]


def test_a_drive_that_is_enabled_already_is_not_dropped_by_the_first_controlword(leg: Leg) -> None:
    robot = leg.attach()
    robot.motor("leg.hip").enable()
    robot.close()
    mark = written_now()
    leg.attach().motor("leg.hip").enable()
    assert leg.controlwords(HIP, mark)
    assert 0x00 not in leg.controlwords(HIP, mark)
    assert not leg.events("torque_off", HIP)


def test_a_drive_that_does_not_obey_is_a_fault_and_not_a_success(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    leg.sim.do(Mute(ids=(HIP,), instruction="rpdo1"))
    with pytest.raises(DeviceFault, match="it cannot be enabled: it stays at switch on disabled"):
        hip.enable()


def test_many_callers_at_once_do_not_mix_up_the_answers_of_the_dictionary(leg: Leg) -> None:
    robot = leg.attach()
    hip, knee = robot.motor("leg.hip"), robot.motor("leg.knee")
    callers = [Outcome(act) for _ in range(4) for act in (hip.home, knee.home, hip.enable, knee.enable)]  # type: ignore[attr-defined]
    errors = [caller.wait().error for caller in callers]
    assert not [error for error in errors if isinstance(error, DeviceFault)]


def test_an_emergency_that_is_too_short_still_counts(leg: Leg) -> None:
    hip = leg.attach().motor("leg.hip")
    hip.enable()
    leg.sim.do(Truncate(ids=(HIP,), instruction="emcy", missing=6))
    leg.sim.do(Mute(ids=(HIP,), instruction="tpdo2"))
    leg.sim.do(Emergency(ids=(HIP,), code=0x4310))
    wait_until(lambda: "4310h" in fault_of(hip), "its error is known")


def test_a_drive_that_cannot_map_an_object_is_refused_and_not_read_one_field_off(rig: Leg) -> None:
    def without_torque(bus: Cia402Bus) -> None:
        for device in bus.devices:
            store: Any = device.store  # type: ignore[attr-defined]
            find = store.find

            def missing(index: int, sub: int, find: Any = find) -> Any:
                if index == 0x6077:
                    raise Abort(AbortCode.NO_OBJECT)
                return find(index, sub)

            store.find = missing

    rig.plug(prepare=without_torque)
    with pytest.raises(ConfigurationError, match="it refuses to be set up: 1A00h:3"):
        rig.attach()


def test_an_adapter_that_echoes_does_not_keep_commands_back(leg: Leg) -> None:
    leg.sim.do(Echo())
    hip = leg.attach().motor("leg.hip")
    assert hip.move_to(0.2) == pytest.approx(0.2, abs=0.01)
    assert leg.goals(HIP) == [round(0.2 * COUNTS_PER_RAD)]


def test_no_thread_but_the_one_of_the_bus_touches_the_library(leg: Leg) -> None:
    before = set(threading.enumerate())
    robot = leg.attach()
    begun = {thread.name for thread in set(threading.enumerate()) - before}
    assert begun == {"bus rosie.legs", "faults of rosie"}  # the latter asks state(), which asks no device
    robot.close()
    assert not set(threading.enumerate()) - before


def test_the_frame_with_the_controlword_counts_at_once_and_those_measured_at_every_sync(leg: Leg) -> None:
    leg.attach()
    types = {}
    for joint in (HIP, KNEE):
        for entry in leg.frames("sdo_request", joint):
            if entry.data[0] & 0xE0 == 0x20 and entry.data[3] == 2:
                types[joint, int.from_bytes(entry.data[1:3], "little")] = entry.data[4]
    for joint in (HIP, KNEE):
        assert (types[joint, 0x1400], types[joint, 0x1800]) == (255, 1)
