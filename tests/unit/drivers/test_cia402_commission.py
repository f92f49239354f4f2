"""Who is on a CAN bus: nodes that are read, and never commanded."""

from typing import Any

import pytest

from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.legs import HIP, KNEE, Leg, leg, rig, stop_by_nmt
from trade_drivers import scan
from trade_drivers.vendors.cia402 import Cia402Driver
from trade_hil_sim import Absent

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]


def looked(leg: Leg, **options: Any) -> list[tuple[int, str, bool | None]]:
    found = scan(Cia402Driver.commissioner(), leg.sim.port, **options)
    return [(one.id, one.model, one.torque) for one in found]


def test_all_nodes_are_asked_and_nothing_is_written_or_commanded(leg: Leg) -> None:
    model = leg.robot.joints[0].model
    assert looked(leg) == [(HIP, model, False), (KNEE, model, False)]
    asked = {frame.data[0] for frame in leg.frames("sdo_request")}
    assert asked
    assert not any(0x20 <= command < 0x40 for command in asked)  # initiates a download
    assert not leg.frames("nmt")
    assert not leg.frames("rpdo1")


def test_a_node_that_is_asked_for_alone(leg: Leg) -> None:
    assert [one[0] for one in looked(leg, ids=[KNEE])] == [KNEE]
    leg.sim.do(Absent(ids=(KNEE,)))
    assert not looked(leg, ids=[KNEE])


def test_a_node_that_network_management_has_stopped_is_shown_and_left_so(leg: Leg) -> None:
    leg.attach().close()
    stop_by_nmt(leg, KNEE)
    mark = written_now()
    [knee] = scan(Cia402Driver.commissioner(), leg.sim.port, ids=[KNEE])
    assert "network management has stopped it" in knee.problem
    assert not leg.frames("nmt", since=mark)
