"""A stop of a group also goes through containers that see what its caller does not see (S07)."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.trade.joint_with_policy import Neck
from tests.unit.trade.test_audit import rows
from trade import Container, Settings, current_call, service, where
from trade.errors import AccessDenied, Stopped
from trade.protocol.keys import ESTOP_PROVIDER
from trade.testing import InFlightMessage, MemorySystem, memory_system
from trade.transport.memory import MemoryTransport

pytestmark = pytest.mark.virtual_time
LEASE_S = 2.0


class Joint:
    """It can be stopped; ``stops`` has the session of each stop, and those that it was asked for."""

    def __init__(self, ends: threading.Event | None = None) -> None:
        self.stops: list[tuple[str, ...]] = []
        self._ends = ends

    @service
    def go(self) -> None:
        """Move."""

    @service(effect="stop")
    def halt(self) -> None:
        """End that."""
        call = current_call()
        assert call is not None
        self.stops.append(call.sessions)
        if self._ends is not None:
            self._ends.wait(60)


@pytest.fixture
def system() -> Iterator[MemorySystem]:
    with memory_system(lease_s=LEASE_S) as made:
        yield made


def offer(system: MemorySystem, name: str, group: str, joint: Joint) -> Container:
    container = system.container(name, identity=name)
    container.register(joint, group)
    return container


def apart(system: MemorySystem, one: Container, other: Container) -> None:
    """They lose each other; the others stay linked to both."""
    system.partition(one, other)
    system.advance(LEASE_S)
    assert other.address not in one.addresses()


def test_S07_a_stop_goes_through_a_container_that_sees_the_group(system: MemorySystem) -> None:
    joint = Joint()
    robot, base, here = (
        offer(system, "rosie", "rosie.neck", joint),
        system.container("base", identity="base"),
        system.container("here", identity="anna"),
    )
    apart(system, here, robot)
    assert not here.services(where(group="rosie"))
    report = here.stop("rosie")
    assert (report.stopped, report.failed) == (("rosie.neck.halt",), {})
    [sessions] = joint.stops
    assert sessions == (f"{base.address}/anna.stop", str(here.address))


def test_S07_what_is_seen_is_stopped_once_and_the_rest_through_others(system: MemorySystem) -> None:
    left, right = Joint(), Joint()
    offer(system, "left", "rosie.left", left)
    robot, here = offer(system, "right", "rosie.right", right), system.container("here")
    for name in ("base", "other"):
        system.container(name)
    assert here.stop("rosie").stopped == ("rosie.left.halt", "rosie.right.halt")
    assert (len(left.stops), len(right.stops)) == (1, 1)  # control: others do not repeat what the caller does
    apart(system, here, robot)
    assert here.stop("rosie").stopped == ("rosie.left.halt", "rosie.right.halt")
    assert len(left.stops) == 2
    assert here.stop("none", limit_s=0.5).stopped == ()


def test_S07_a_stop_that_is_not_confirmed_soon_is_sent_again_by_others(system: MemorySystem) -> None:
    joint = Joint()
    robot, base, here = offer(system, "rosie", "rosie.neck", joint), system.container("base"), system.container("here")
    system.partition(here, robot)  # and the lease is not over: both still see each other
    began = time.monotonic()
    report = here.stop("rosie", limit_s=1.5)
    assert report.complete
    assert time.monotonic() - began < 1.0
    assert [sessions[0] for sessions in joint.stops] == [f"{base.address}/tester.stop"]


def test_S07_a_relay_that_dies_before_it_confirms_is_not_the_only_one(system: MemorySystem) -> None:
    joint = Joint()
    robot, here = offer(system, "rosie", "rosie.neck", joint), system.container("here")
    relays = [system.container(name) for name in ("base", "other")]
    apart(system, here, robot)

    def die(message: InFlightMessage) -> None:
        if message.target == "base" and message.arrived and "stop/" in message.key:
            system.kill("base")

    untap = system.tap(die)
    report = here.stop("rosie")
    untap()
    assert report.complete
    assert f"{relays[1].address}/tester.stop" in [sessions[0] for sessions in joint.stops]


def test_S07_the_confirmation_that_counts_is_the_robots(system: MemorySystem) -> None:
    ends = threading.Event()
    robot, here = offer(system, "rosie", "rosie.neck", Joint(ends)), system.container("here")
    system.container("base")
    apart(system, here, robot)
    report = here.stop("rosie", limit_s=1.0)
    assert not report.complete
    assert not report.stopped
    ends.set()
    report = here.stop("rosie", limit_s=1.0)
    assert report.complete
    system.kill("base")
    report = here.stop("rosie", limit_s=1.0)
    assert not report.complete


def test_S08_a_stop_through_the_container_that_moves_it_latches(system: MemorySystem) -> None:
    neck = Neck()
    robot, base, here = system.container("rosie"), system.container("base"), system.container("here")
    robot.register(neck, "rosie.neck")
    apart(system, here, robot)
    move = base.find("rosie.neck.move")
    with base.lock(where(group="rosie.neck")):
        move(0.1)
        assert base.stop("rosie").complete
        move(0.2)  # control: its own stop does not latch
        assert here.stop("rosie").complete
        with pytest.raises(Stopped):
            move(0.3)
    assert neck.moved == [0.1, 0.2]


POLICY = """
revoked = ["mallory"]
[roles.driver]
register = ["rosie"]
[identities]
rosie = ["driver"]
"""


def test_S07_a_relay_checks_who_asks_and_its_record_names_them(system: MemorySystem, tmp_path: Path) -> None:
    joint, policy = Joint(), tmp_path / "policy.toml"
    policy.write_text(POLICY + 'anna = []\nbase = []\nmallory = ["driver"]\n')
    robot = offer(system, "rosie", "rosie.neck", joint)
    settings = Settings(system="memory", identity="base", container="base", policy=policy, audit=tmp_path / "audit")
    transport = MemoryTransport(system.network, "base")
    with Container(settings, transport=transport) as base:
        anna = system.container("here", identity="anna")
        mallory = system.container("there", identity="mallory")
        for one in (anna, mallory):
            apart(system, one, robot)
        report = mallory.stop("rosie", limit_s=0.5)
        assert not report.stopped
        assert not joint.stops
        assert AccessDenied.__name__ in report.failed["base/base"]
        assert anna.stop("rosie").complete  # any identity may stop
        assert [sessions[0] for sessions in joint.stops] == [f"{base.address}/anna.stop"]
        found = rows(base, tmp_path / "audit")
    asked = [(row.kind, row.what, row.about, row.who, row.outcome) for row in found if row.what == "trade.stop_group"]
    assert ("stop", "trade.stop_group", "rosie", "anna", "ok") in asked
    assert ("refused", "trade.stop_group", "", "mallory", "AccessDenied") in asked


def estop_calls(system: MemorySystem) -> list[str]:
    """The keys of calls of the e-stop service, from now on."""
    keys: list[str] = []

    def seen(message: InFlightMessage) -> bool:
        if "stop/" in message.key and message.key.endswith(f"/{ESTOP_PROVIDER}"):
            keys.append(message.key)
        return False

    system.lose(seen)
    return keys


def test_S09_an_e_stop_is_confirmed_through_a_container_that_sees_the_robot(system: MemorySystem) -> None:
    joint = Joint()
    robot, base, here = offer(system, "rosie", "rosie.neck", joint), system.container("base"), system.container("here")
    apart(system, here, robot)
    began, calls = time.monotonic(), estop_calls(system)
    report = here.estop("smoke")
    assert report.complete
    assert len(calls) == 1
    assert robot.address.who in report.confirmed
    assert time.monotonic() - began < 2.0
    assert len(joint.stops) == 1
    with pytest.raises(Stopped):
        base.find(where(name="go"))()


def test_S09_an_e_stop_that_all_confirm_goes_through_no_other_container(system: MemorySystem) -> None:
    """The control: others do not repeat what the links have done."""
    offer(system, "rosie", "rosie.neck", Joint())
    system.container("base")
    here, calls = system.container("here"), estop_calls(system)
    assert here.estop("smoke").complete
    assert calls == []
