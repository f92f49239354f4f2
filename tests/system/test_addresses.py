"""Addresses that come late, are dead, or change: a robot is found at those that its host has now.

Each with the control: the same robot with one good address from its start.
"""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.system.networks import Member, Networks, ip

BASE, ROVER = "10.77.0.1", "10.77.0.2"
BOTH = ["base", "rover"]
Join = Callable[[str], Member]


@pytest.fixture
def lan(networks: Networks) -> Networks:
    networks.lay("lan", base=BASE, rover=ROVER)
    return networks


@pytest.fixture
def join(lan: Networks, system: str, tmp_path: Path) -> Iterator[Join]:
    """A container that listens on all networks of its host and registers five services."""
    members: list[Member] = []

    def begin(name: str) -> Member:
        members.append(Member(lan.host(name), name, "0.0.0.0:7450", tmp_path))
        members[-1].ask("start")
        members[-1].ask("register")
        return members[-1]

    yield begin
    for member in members:
        member.close()


def address(lan: Networks, verb: str, ip_address: str, host: str = "rover") -> None:
    ip("-n", lan.host(host), "addr", verb, f"{ip_address}/24", "dev", "lan")


def seconds_until_found(*members: Member) -> float:
    began = time.monotonic()
    for member in members:
        assert len(member.ask("sees", "10")) == 10, [member.ask("state") for member in members]
    return time.monotonic() - began


def join_in_order(join: Join, first: str) -> list[Member]:
    """Both, in the order of their names; the session of the later one has the greater id, and dials if both may."""
    members = {name: join(name) for name in sorted(BOTH, key=lambda name: name != first)}
    ids = {name: bytes.fromhex(member.ask("id").zfill(32))[::-1] for name, member in members.items()}
    assert min(BOTH, key=lambda name: ids[name]) == first
    return [members[name] for name in BOTH]


def seconds_of_control(join: Join) -> float:
    base, rover = join("base"), join("rover")
    for member in (base, rover):
        member.ask("find_each_other")
    took_s = seconds_until_found(base, rover)
    for member in (base, rover):
        member.ask("stop")
    return took_s


def test_N1_a_robot_that_starts_before_its_network_has_an_address_is_found(lan: Networks, join: Join) -> None:
    control_s = seconds_of_control(join)
    address(lan, "del", ROVER)
    base, rover = join("base"), join("rover")
    for member in (base, rover):
        member.ask("find_each_other")
    assert len(base.ask("seen", "base.p0")) == 1
    assert base.ask("seen", "rover.p0") == []

    address(lan, "add", ROVER)

    assert seconds_until_found(base, rover) < 10 + control_s


@pytest.mark.parametrize("who", BOTH)
def test_N1_connect_to_a_right_address_works_whichever_id_is_the_greater(lan: Networks, join: Join, who: str) -> None:
    for first in BOTH:
        address(lan, "del", ROVER)
        base, rover = join_in_order(join, first)
        address(lan, "add", ROVER)

        dials, to = (base, ROVER) if who == "base" else (rover, BASE)
        dials.ask("connect", f"tcp/{to}:7450")

        assert seconds_until_found(base, rover) < 10
        for member in (base, rover):
            member.ask("stop")


def test_N2_six_dead_addresses_cost_little(lan: Networks, join: Join) -> None:
    control_s = seconds_of_control(join)
    address(lan, "del", ROVER)
    for number in range(6):
        address(lan, "add", f"10.99.{number}.1")
    address(lan, "add", ROVER)  # the last of seven
    base = lan.host("base")  # what base sends to the others disappears
    ip("-n", base, "link", "add", "vpn", "type", "bridge")
    ip("-n", base, "addr", "add", "10.98.0.1/24", "dev", "vpn")
    ip("-n", base, "link", "set", "vpn", "up")
    ip("-n", base, "neigh", "add", "10.98.0.2", "lladdr", "02:00:00:00:00:99", "dev", "vpn", "nud", "permanent")
    ip("-n", base, "route", "add", "10.99.0.0/16", "via", "10.98.0.2")

    for first in BOTH:
        near, far = join_in_order(join, first)
        for member in (near, far):
            member.ask("find_each_other")
        assert seconds_until_found(near, far) < 2 * control_s + 5
        for member in (near, far):
            member.ask("stop")


def test_N3_a_robot_whose_address_changes_is_linked_again(lan: Networks, join: Join) -> None:
    base, rover = join("base"), join("rover")
    for member in (base, rover):
        member.ask("find_each_other")
    seconds_until_found(base, rover)

    address(lan, "del", ROVER)
    address(lan, "add", "10.77.0.9")
    assert len(base.ask("sees", "5")) == 5  # the old links are lost in order

    assert seconds_until_found(base, rover) < 15
    assert base.ask("call_all") == 10


def test_two_robots_that_swap_addresses_are_both_found_again(lan: Networks, join: Join) -> None:
    lan.lay("yard", base="10.78.0.1", rover="10.78.0.2", digger="10.78.0.3")
    base, rover, digger = join("base"), join("rover"), join("digger")
    members = (base, rover, digger)
    for member in members:
        member.ask("find_each_other")
    assert len(base.ask("sees", "15")) == 15

    for host, before, now in (("rover", 2, 4), ("digger", 3, 2), ("rover", 4, 3)):
        ip("-n", lan.host(host), "addr", "del", f"10.78.0.{before}/24", "dev", "yard")
        ip("-n", lan.host(host), "addr", "add", f"10.78.0.{now}/24", "dev", "yard")

    digger.ask("sees", "5")
    for member in members:
        assert len(member.ask("sees", "15")) == 15, [each.ask("state") for each in members]
    assert base.ask("call_all") == 15
