"""Drives that take a new PDO mapping only while pre-operational: at attach, and when they are set up again."""

from typing import Any

import can
import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.legs import HIP, KNEE, Leg, fault_of, rig
from trade.errors import DeviceFault
from trade_drivers.vendors.cia402 import _table as table
from trade_hil_sim import LogEntry, Mute

pytestmark = [pytest.mark.virtual_time, pytest.mark.parametrize("strict", [True, False], ids=["strict", "tolerant"])]

__all__ = ["rig"]

PRE_OPERATIONAL = bytes((table.NMT_PREOPERATIONAL, HIP))


def plug(rig: Leg, strict: bool) -> None:
    def prepare(bus: Any) -> None:
        for device in bus.devices if strict else ():
            device.node.map_only_pre_operational()

    rig.plug(prepare=prepare)


def mappings(leg: Leg, since: float = 0.0) -> list[LogEntry]:
    """Requests to write an object of the hip's PDOs (1400h to 1BFFh)."""
    writes = [entry for entry in leg.frames("sdo_request", HIP, since) if entry.data[0] & 0xE0 == 0x20]
    return [entry for entry in writes if 0x14 <= entry.data[2] <= 0x1B]


def aborts(leg: Leg, since: float) -> list[LogEntry]:
    return [entry for entry in leg.frames("sdo_reply", HIP, since) if entry.data[0] == 0x80]


def optional(leg: Leg, since: float) -> list[LogEntry]:
    """Refusals because an object does not exist, or cannot be written."""
    return [entry for entry in aborts(leg, since) if entry.data[4:] != table.NOT_IN_THIS_STATE.to_bytes(4, "little")]


def test_S18_a_drive_that_holds_is_attached_again_and_stays(rig: Leg, strict: bool) -> None:
    plug(rig, strict)
    first = rig.attach()
    first.motor("leg.hip").move_to(0.3)
    first.close()
    mark = written_now()
    motor = rig.attach().motor("leg.hip")
    [slept] = [entry for entry in rig.frames("nmt", since=mark) if entry.data == PRE_OPERATIONAL]
    assert rig.log.index(slept) < rig.log.index(mappings(rig, mark)[0])
    assert aborts(rig, mark) == optional(rig, mark)
    assert motor.state().enabled
    assert not rig.events("torque_off", HIP, mark)
    assert not rig.events("motion_started", HIP, mark)
    assert motor.move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_S18_a_drive_whose_heartbeats_were_lost_is_back_soon_and_has_not_moved(rig: Leg, strict: bool) -> None:
    plug(rig, strict)
    motor = rig.attach().motor("leg.hip")
    motor.move_to(0.3)
    mark = written_now()
    rig.sim.do(Mute(ids=(HIP,), instruction="heartbeat", count=4))
    wait_until(lambda: fault_of(motor), "it is back, and says why it holds")
    assert fault_of(motor) == "it was away"
    started = [entry for entry in rig.frames("nmt", since=mark) if entry.data == bytes((table.NMT_START, HIP))]
    assert len(started) == 1
    assert started[0].t - mark < 3.0
    assert rig.frames("nmt", since=mark)[0].data == PRE_OPERATIONAL
    with pytest.raises(DeviceFault, match="it was away"):
        motor.move_to(0.1)
    motor.enable()
    motor.stop()
    assert not rig.events("torque_off", HIP, mark)
    assert not rig.events("motion_started", HIP, mark)
    assert motor.move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_a_drive_that_another_program_has_started_is_attached(rig: Leg, strict: bool) -> None:
    plug(rig, strict)
    with rig.listen() as other:
        for node in (HIP, KNEE):
            other.send(can.Message(arbitration_id=0, data=bytes((table.NMT_START, node)), is_extended_id=False))
        wait_until(lambda: len(rig.events("nmt")) >= 4, "both are operational, and send no heartbeats")
    assert rig.attach().motor("leg.hip").move_to(0.3) == pytest.approx(0.3, abs=0.01)
    asked = [entry for entry in rig.frames("nmt") if entry.data == PRE_OPERATIONAL]
    assert len(asked) == strict
