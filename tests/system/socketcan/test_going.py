"""Interfaces that disappear: reported to each waiting caller, no motion when they come back, and back by themselves."""

import re

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.socketcan.interfaces import down, ip, up
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import HIP, Leg, fault_of, leg
from trade.errors import BusGone
from trade_drivers import AttachedRobot
from trade_drivers.bus.can import CanPort
from trade_drivers.joints import PortLost
from trade_hil_sim import Replug

__all__ = ["leg"]


@pytest.fixture
def interface(own_interface: str) -> str:
    return own_interface


@pytest.mark.parametrize(("going", "says"), [("down", "Error Code 100"), ("deleted", "Error Code (19|6)")])
def test_a_receive_that_waits_and_a_send_end_when_the_interface_goes(interface: str, going: str, says: str) -> None:
    port = CanPort(f"socketcan:{interface}", 1_000_000)
    port.open()
    waiting = Outcome(lambda: port.receive(PATIENCE_S))
    if going == "down":
        down(interface)
    else:
        ip("link", "del", interface)
    error = waiting.wait().error
    assert isinstance(error, PortLost)
    assert re.search(f"Error Code 100|{says}", str(error))  # who is deleted goes down first
    with pytest.raises(PortLost, match=says):
        port.send(0x123, b"")
    with pytest.raises(PortLost, match="there is no interface" if going == "deleted" else "it is down"):
        port.open()


@pytest.mark.parametrize("going", ["down", "deleted"])
def test_S18_an_interface_lost_while_moving_is_reported_and_reconnects_by_itself(leg: Leg, going: str) -> None:
    robot = leg.attach()
    hip = robot.motor("leg.hip")
    moving = Outcome(lambda: hip.move_to(0.9, 0.2))
    started = leg.wait_for("motion_started", HIP)
    if going == "down":
        down(leg.interface)
    else:
        ip("link", "del", leg.interface)
    error = moving.wait().error
    assert isinstance(error, BusGone)
    leg.wait_for("at_rest", HIP, started.t)
    mark = written_now()
    if going == "deleted":
        wait_until(lambda: not leg.sim.state().plugged, "the simulator has noticed")
        wait_until(lambda: "there is no interface" in reason(robot), "the caller gets the reason")
        ip("link", "add", leg.interface, "type", "vcan")
    else:
        wait_until(lambda: "it is down; `ip link set" in reason(robot), "the caller gets the reason")
    up(leg.interface)
    if going == "deleted":
        leg.sim.do(Replug())
    wait_until(lambda: "it was away" in fault_of(hip), "it is heard again")
    assert not leg.goals(HIP, mark)
    assert not leg.events("motion_started", HIP, mark)


def reason(robot: AttachedRobot) -> str:
    try:
        robot.motor("leg.hip").state()
    except BusGone as gone:
        return str(gone)
    return ""
