"""Bad days of a gateway: it dies, or a network is cut, while a lock is held across it and a joint moves under it.

The joint is a simulated servo on the private network, and its log is the judge.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from signal import SIGKILL

import pytest

from tests.support import simulated_robots as robots
from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from tests.system.conftest import Bench
from tests.system.networks import Member, Networks, ip
from tests.system.sites import GATEWAY, SYSTEM, Site
from trade_hil_sim import events

pytestmark = [pytest.mark.timeout(300)]

POLICY = policy_text(
    "rosie=driver arm=driver planner=operator",
    head='gateways = ["door"]\n',
    driver="register=rosie",
    operator="read=* call=rosie lock=rosie",
)
PAN, FAR_RAD, SPEED_RAD_S = "rosie.neck.pan", 1.3, 0.1
"""A motion of 13 s: what is not stopped is still under way when all have noticed."""
LEASE_S = 2.5
"""More than the transport's and a lock's."""


@pytest.fixture
def site(networks: Networks, tmp_path: Path) -> Iterator[Site]:
    made = Site(networks, tmp_path, POLICY, private='["rosie"]')
    yield made
    made.close()


@pytest.fixture
def bench(site: Site, system: str, monkeypatch: pytest.MonkeyPatch, benches: Callable[..., Bench]) -> Bench:
    """The robot, its driver on the private network."""
    for name, value in (
        ("TRADE_SYSTEM", SYSTEM),
        ("TRADE_TLS", str(site.papers.of("rosie"))),
        ("TRADE_POLICY", str(site.policy)),
        ("TRADE_CONNECT", GATEWAY["private"]),
    ):
        monkeypatch.setenv(name, value)
    file = site.folder / "head.toml"
    file.write_text(robots.HEAD)
    made = benches(file, inside=site.networks.host("left"))
    for name in ("TRADE_TLS", "TRADE_POLICY", "TRADE_CONNECT"):
        monkeypatch.delenv(name)
    return made


@pytest.fixture
def planner(site: Site, bench: Bench) -> Member:
    """On the public network, with the lock, and with the joint moving under it."""
    made = site.member("right", "planner")
    made.ask("hold_when_there", PAN)
    begin_to_move(bench, made, FAR_RAD)
    return made


def position_rad(bench: Bench) -> float:
    [bus] = bench.sim.control.state()
    return bus.devices[0].position_rad


def begin_to_move(bench: Bench, planner: Member, where_rad: float) -> None:
    before = len(events(bench.sim.entries(), "motion_started", device_id=1))
    planner.ask("started", "move_to", PAN, str(where_rad), str(SPEED_RAD_S))
    wait_until(lambda: len(events(bench.sim.entries(), "motion_started", device_id=1)) > before, "it moves")


def comes_to_rest_far_from_its_goal(bench: Bench) -> None:
    wait_until(lambda: bool(bench.rests("neck.pan")), "it comes to rest")
    assert abs(bench.rests("neck.pan")[0]) < FAR_RAD / 2
    assert not events(bench.sim.entries(), "watchdog_expired"), "its driver stopped it"


def everything_is_lost_at_once(bench: Bench, planner: Member) -> None:
    comes_to_rest_far_from_its_goal(bench)
    assert planner.refused("ended").partition(":")[0] in ("ContainerLost", "LockLost")
    wait_until(lambda: not planner.ask("still_held"), "its owner is notified")


def it_works_again(bench: Bench, planner: Member) -> None:
    """With a lock of its own, and nothing of before continues or comes late."""
    goals = len(events(bench.sim.entries(), "motion_started", device_id=1))
    planner.ask("unlock")
    planner.ask("hold_when_there", PAN)
    assert len(events(bench.sim.entries(), "motion_started", device_id=1)) == goals
    planner.ask("started", "move_to", PAN, "0.0", "2.0")
    planner.ask("ended")
    assert abs(bench.rests("neck.pan")[-1]) < 0.05
    planner.ask("unlock")


def test_S12_a_gateway_that_is_killed_ends_lock_and_motion_and_the_next_one_serves(
    site: Site, bench: Bench, planner: Member
) -> None:
    site.end(SIGKILL)
    everything_is_lost_at_once(bench, planner)
    site.begin()
    it_works_again(bench, planner)


@pytest.mark.parametrize(("network", "host"), [("net1", "left"), ("net2", "right")], ids=["private", "public"])
def test_S12_a_network_that_is_cut_ends_lock_and_motion_and_heals(
    site: Site, bench: Bench, planner: Member, network: str, host: str
) -> None:
    """The control is a cut of a moment, less than a lease: it loses nothing, though one waits for as long as one."""
    for state in ("down", "up"):
        cut(site.networks, network, host, state)
    far_rad = position_rad(bench) + LEASE_S * SPEED_RAD_S
    wait_until(lambda: position_rad(bench) > far_rad, "it continues")
    assert planner.ask("still_held")
    cut(site.networks, network, host, "down")
    everything_is_lost_at_once(bench, planner)
    cut(site.networks, network, host, "up")
    it_works_again(bench, planner)


def cut(networks: Networks, network: str, host: str, state: str) -> None:
    """At the switch: neither end is notified."""
    ip("-n", networks.host(f"{network}-switch"), "link", "set", host, state)
