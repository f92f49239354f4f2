"""A send queue of ten frames, the length that Linux gives an interface: six drives and two."""

import re
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from tests.support.waiting import wait_until
from tests.system.socketcan.interfaces import ip
from tests.system.socketcan.slcan_adapter import SlcanAdapter
from tests.unit.drivers.legs import LEG, Leg
from trade_drivers import parse
from trade_drivers.bus._jobs import PortFull
from trade_drivers.bus.can import CanPort, ErrorState, look_at
from trade_gateway.cli.hardware._doctor_robot import judged

_LENGTH = 10
_HIP = re.search(r'\[joint."leg.hip"\].*?\n\n', LEG, re.DOTALL)


class Legs(Leg):
    """Drives on an interface, as many as a test wants."""

    def of(self, drives: int) -> None:
        assert _HIP is not None
        more = dict(zip(("yaw", "roll", "ankle", "toe"), range(3, drives + 1)))  # noqa: B905 - as many as wanted
        added = [_HIP[0].replace("leg.hip", f"leg.{name}").replace("id = 1", f"id = {n}") for name, n in more.items()]
        names = ", ".join(f'"leg.{name}"' for name in ("hip", "knee", *more))
        text = self.text.replace("[group.leg]", f"{''.join(added)}[group.leg]")
        self.text = text.replace('joints = ["leg.hip", "leg.knee"]', f"joints = [{names}]")
        self.robot = parse(self.text, "legs.toml")


@pytest.fixture
def legs(interface: str, adapter: SlcanAdapter) -> Iterator[Legs]:
    ip("link", "set", adapter.interface, "txqueuelen", str(_LENGTH))
    with ExitStack() as undo:
        yield Legs(undo, interface, rate_hz=20)


@pytest.mark.parametrize("drives", [2, 6])
def test_every_command_of_a_group_works_behind_a_queue_of_ten_frames(
    legs: Legs, adapter: SlcanAdapter, drives: int
) -> None:
    legs.of(drives)
    legs.plug()
    robot = legs.attach(ports={"legs": f"socketcan:{adapter.interface}"})
    group = robot.group("leg")
    for joint in legs.robot.joints:
        robot.motor(joint.name).enable()
    for goal in [0.05, 0.0] * 4:
        assert group.move_to([goal] * drives) == pytest.approx([goal] * drives, abs=0.01)
    link = look_at(adapter.interface)
    assert link.queue == _LENGTH
    found = judged(legs.robot.buses[0], link, drives)
    assert ("txqueuelen 128" in found.fix) == (3 * drives > _LENGTH)


@pytest.mark.usefixtures("legs")
def test_a_queue_that_nothing_empties_is_named_with_the_state_of_the_bus(adapter: SlcanAdapter) -> None:
    port = CanPort(f"socketcan:{adapter.interface}", 1_000_000)
    port.open()
    adapter.say("p", 128)
    wait_until(lambda: look_at(adapter.interface).state is ErrorState.PASSIVE, "the system knows")
    adapter.deaf = True
    said = rf"the send queue of {adapter.interface} \(txqueuelen 10\) has been full .* error-passive; nothing acknowl"
    with pytest.raises(PortFull, match=said):
        for _ in range(5000):
            port.send(0x123, bytes(8))
    port.close()
