"""A real controller's states, and lost interfaces: reported, no motion when they return, and back by themselves."""

import pytest

from tests.support.waiting import wait_until
from tests.system.socketcan.interfaces import down, up
from tests.system.socketcan.slcan_adapter import SlcanAdapter
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.legs import HIP, Leg, fault_of, leg
from trade.errors import BusGone, DeviceFault
from trade_drivers import AttachedRobot

__all__ = ["leg"]


@pytest.fixture
def robot(leg: Leg, adapter: SlcanAdapter) -> AttachedRobot:
    return leg.attach(ports={"legs": f"socketcan:{adapter.interface}"})


def test_changes_of_a_controllers_error_state_are_reported(
    leg: Leg, adapter: SlcanAdapter, robot: AttachedRobot
) -> None:
    monitor = robot.monitor("legs")
    assert (monitor.bus_state().state, monitor.health()) == ("error-active", "healthy")
    for letter, errors, state, health in (
        ("w", 96, "error-warning", "healthy"),
        ("p", 128, "error-passive", "degraded: CAN error-passive"),
        ("a", 10, "error-active", "healthy"),
    ):
        adapter.say(letter, errors)
        wait_until(lambda state=state: monitor.bus_state().state == state, state)
        assert monitor.health() == health
    assert monitor.bus_state().error_frames >= 3
    assert robot.motor("leg.hip").move_to(0.1) == pytest.approx(0.1, abs=0.01)


def test_S18_a_bus_off_while_moving_is_reported_and_nothing_moves_afterwards(
    leg: Leg, adapter: SlcanAdapter, robot: AttachedRobot
) -> None:
    hip, monitor = robot.motor("leg.hip"), robot.monitor("legs")
    moving = Outcome(lambda: hip.move_to(0.9, 0.2))
    started = leg.wait_for("motion_started", HIP)
    adapter.say("b", 255)
    error = moving.wait().error
    assert isinstance(error, BusGone)
    assert f"ip link set {adapter.interface} down" in str(error)
    assert (monitor.bus_state().state, monitor.bus_state().up) == ("bus-off", False)
    assert monitor.health() == "degraded: CAN bus-off"
    leg.wait_for("at_rest", HIP, started.t)  # by the drive's own watchdog
    mark = written_now()
    down(adapter.interface)
    up(adapter.interface)
    adapter.off = False
    wait_until(lambda: "it was away" in fault_of(hip), "it is heard again")
    assert (monitor.bus_state().state, monitor.bus_state().bus_offs) == ("error-active", 1)
    with pytest.raises(DeviceFault):
        hip.move_to(0.0)
    assert not leg.goals(HIP, mark)
    assert not leg.events("motion_started", HIP, mark)
    hip.enable()
    assert hip.move_to(0.0) == pytest.approx(0.0, abs=0.01)
