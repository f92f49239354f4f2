"""A real controller's states as a port sees them, and interfaces that go."""

from collections.abc import Iterator

import pytest

from tests.support.waiting import wait_until
from tests.system.socketcan.interfaces import down, up
from tests.system.socketcan.slcan_adapter import SlcanAdapter
from tests.unit.drivers.legs import Leg, leg
from trade.errors import ConfigurationError
from trade_drivers.bus.can import CanPort, ErrorState
from trade_drivers.bus.can._netlink import look_at
from trade_drivers.joints import PortLost
from trade_hil_sim import SimulationError
from trade_hil_sim.can import CanBus

__all__ = ["leg"]


@pytest.fixture
def port(adapter: SlcanAdapter) -> Iterator[CanPort]:
    made = CanPort(f"socketcan:{adapter.interface}", 1_000_000)
    made.open()
    yield made
    made.close()


def test_a_controller_that_is_bus_off_is_not_attached_to(leg: Leg, adapter: SlcanAdapter) -> None:
    adapter.say("b", 255)
    wait_until(lambda: look_at(adapter.interface).state is ErrorState.BUS_OFF, "the system knows")
    with pytest.raises(ConfigurationError, match="bus-off: too many errors"):
        leg.attach(ports={"legs": f"socketcan:{adapter.interface}"})
    assert not leg.announced


def heard(port: CanPort, state: str) -> bool:
    port.receive(0.1)
    return port.look("x").state == state


def test_a_port_follows_its_controller(adapter: SlcanAdapter, port: CanPort) -> None:
    for letter, errors, state in (("w", 96, "error-warning"), ("p", 128, "error-passive"), ("a", 10, "error-active")):
        adapter.say(letter, errors)
        wait_until(lambda state=state: heard(port, state), state)
        assert look_at(adapter.interface).state is port.state  # the system says the same
    assert (port.errors, port.bus_offs) == (3, 0)


def test_a_port_that_is_opened_later_knows_what_was_before(adapter: SlcanAdapter, port: CanPort) -> None:
    adapter.say("p", 128)
    wait_until(lambda: heard(port, "error-passive"), "the system knows")
    port.close()
    later = CanPort(port.path, 1_000_000)
    later.open()
    assert later.look("x").state == "error-passive"
    later.close()


def test_a_bus_off_is_a_loss_until_the_interface_was_down_and_up(adapter: SlcanAdapter, port: CanPort) -> None:
    adapter.say("b", 255)
    with pytest.raises(PortLost, match=f"bus-off: .* `ip link set {adapter.interface} down` and `up`"):
        wait_until(lambda: heard(port, "bus-off"), "it is lost")
    with pytest.raises(PortLost, match="bus-off"):
        port.open()
    down(adapter.interface)
    with pytest.raises(PortLost, match=f"it is down; `ip link set {adapter.interface} up`"):
        port.open()
    up(adapter.interface)
    port.open()
    assert (port.look("x").state, port.bus_offs) == ("error-active", 1)


def test_simulated_devices_refuse_an_interface_that_is_not_there() -> None:
    with pytest.raises(SimulationError, match="there is no interface vcan99; `ip link add vcan99 type vcan`"):
        CanBus(interface="vcan99").open()
