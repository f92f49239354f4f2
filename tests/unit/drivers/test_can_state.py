"""The state of a CAN bus: by its service, by the health of its joints, and by the operating system."""

import itertools
import struct
from collections.abc import Callable

import can
import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.legs import HIP, Leg, leg, rig
from trade import Container, where
from trade_drivers import CanBusState, CanMonitor
from trade_drivers.bus.can import CanPort, ErrorState, frame_bits
from trade_drivers.bus.can._netlink import Link, look_at, parse_link
from trade_drivers.joints import PortLost
from trade_hil_sim import BadCrc, BusOff, Heal, Replug, Unplug

pytestmark = pytest.mark.virtual_time

__all__ = ["leg", "rig"]

_numbers = itertools.count()


def test_a_healthy_bus_says_so(leg: Leg) -> None:
    state = leg.attach().monitor("legs").bus_state()
    assert (state.name, state.port, state.up) == ("rosie.bus.legs", leg.sim.port, True)
    assert (state.state, state.error_frames, state.bus_offs) == ("error-active", 0, 0)


def test_the_load_is_that_of_the_frames_on_the_wire(leg: Leg) -> None:
    monitor = leg.attach().monitor("legs")
    began = leg.frames("sync")[-1].t
    wait_until(lambda: monitor.bus_state().load > 0 and leg.frames("sync")[-1].t > began + 2, "two windows are over")
    load, seen = monitor.bus_state().load, leg.frames(since=began)
    expected = sum(frame_bits(len(entry.data)) for entry in seen) / (seen[-1].t - began) / 1_000_000
    assert expected / 2 < load < expected * 2


def test_error_frames_are_counted(leg: Leg) -> None:
    monitor = leg.attach().monitor("legs")
    leg.sim.do(BadCrc(ids=(HIP,), instruction="tpdo1", count=5))
    wait_until(lambda: monitor.bus_state().error_frames == 5, "all five were heard of")
    assert monitor.bus_state().state == "error-active"


def test_a_bus_off_is_reported_until_the_bus_is_heard_again(leg: Leg) -> None:
    monitor = leg.attach().monitor("legs")
    leg.sim.do(BusOff())
    wait_until(lambda: monitor.bus_state().state == "bus-off", "it is known")
    wait_until(lambda: monitor.bus_state().up, "the adapter could be opened again")
    assert monitor.bus_state().state == "bus-off"
    leg.sim.do(Heal())
    wait_until(lambda: monitor.bus_state().state == "error-active", "it is over")
    assert (monitor.bus_state().bus_offs, monitor.bus_state().up) == (1, True)
    assert not leg.goals(HIP)


def test_the_state_of_the_bus_is_a_service_of_the_robot_that_any_client_can_call(
    leg: Leg, start_container: Callable[..., Container]
) -> None:
    driver, asker = start_container("driver"), start_container("asker")
    leg.attach(register=driver.register, deregister=driver.deregister)
    state = asker.find(where(name="bus_state", group="rosie"), wait_s=10)()
    assert isinstance(state, CanBusState)
    assert state.state == "error-active"
    assert not [handle for handle in asker.services(where(group="rosie.bus")) if handle.effect != "read"]


def test_joints_groups_and_the_bus_report_that_the_bus_is_unhealthy_and_healthy_again(leg: Leg) -> None:
    reported: list[tuple[object, str]] = []
    robot = leg.attach(set_health=lambda provider, health: reported.append((provider, health)))
    providers = set(robot.providers.values())
    leg.sim.do(Unplug())
    wait_until(
        lambda: {provider for provider, health in reported if "CAN bus gone" in health} == providers, "all report it"
    )
    reported.clear()
    leg.sim.do(Replug())
    wait_until(
        lambda: {provider for provider, health in reported if health == "healthy"} == providers, "all are healthy"
    )


@pytest.mark.parametrize(
    ("frame_id", "data", "health"),
    [
        (0x004, 0x04, "healthy"),
        (0x004, 0x20, "degraded: CAN error-passive"),
        (0x040, 0x00, "degraded: CAN bus-off"),
    ],
)
def test_health_is_degraded_from_error_passive_on(frame_id: int, data: int, health: str) -> None:
    channel = f"test_can_state_{next(_numbers)}"
    port = CanPort(f"virtual:{channel}", 1_000_000)
    port.open()
    monitor = CanMonitor(lambda: port.look("rosie.bus.legs"))
    with can.Bus(interface="virtual", channel=channel) as peer:
        peer.send(can.Message(arbitration_id=frame_id, data=bytes((0, data)), is_error_frame=True))
        try:
            assert port.receive(5) is None
        except PortLost:
            assert "bus-off" in health
    assert monitor.health() == health
    port.close()


def attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def answer(flags: int, *attributes: bytes) -> bytes:
    body = struct.pack("=BxHiII", 0, 280, 7, flags, 0) + b"".join(attributes)
    return struct.pack("=IHHII", 16 + len(body), 16, 0, 0, 0) + body


@pytest.mark.parametrize(("number", "state"), [(0, ErrorState.ACTIVE), (3, ErrorState.BUS_OFF), (4, None)])
def test_the_state_of_a_controller_is_parsed_from_the_reply_of_the_kernel(
    number: int, state: ErrorState | None
) -> None:
    data = attribute(2, attribute(1, bytes(32)) + attribute(4, number.to_bytes(4, "little")))
    reported = answer(1, attribute(3, b"can0\0"), attribute(18, attribute(1, b"can") + data))
    assert parse_link(reported) == Link(True, state)
    assert parse_link(answer(0)) == Link(False, None)


@pytest.mark.parametrize("text", [b"", bytes(36), answer(1)[:20]], ids=["nothing", "an error", "cut short"])
def test_what_is_no_answer_is_refused(text: bytes) -> None:
    with pytest.raises(OSError, match="the system reports nothing about"):
        parse_link(text)


def test_no_cut_in_an_answer_is_a_crash() -> None:
    whole = answer(1, attribute(18, attribute(2, attribute(4, bytes(4)))))
    assert {parse_link(whole[:end]).up for end in range(32, len(whole))} == {True}


@pytest.mark.real_clock
def test_an_existing_interface_is_found_and_a_missing_one_is_named() -> None:
    assert look_at("lo").state is None
    with pytest.raises(OSError, match="there is no interface nothere0"):
        look_at("nothere0")
    with pytest.raises(PortLost, match="there is no interface nothere0"):
        CanPort("socketcan:nothere0", 1_000_000).open()
