"""Several hosts, as network namespaces joined by a cable that can be pulled."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.certificates import Papers
from tests.support.waiting import wait_until
from tests.system.conftest import ROSIES_HEAD, Bench, Program
from tests.system.member import PROVIDERS
from tests.system.networks import Member, Networks, ip
from trade_hil_sim import events

ROUNDS = int(os.environ.get("SOAK_ROUNDS", "20"))
MOVER = Path(__file__).with_name("mover.py")
HALFWAY_RAD = 0.65
pytestmark = [pytest.mark.timeout(120 + 15 * ROUNDS)]


class Cable:
    """Two hosts, ``left`` at 10.231.7.1 and ``right`` at 10.231.7.2, and what joins them."""

    def __init__(self, networks: Networks) -> None:
        networks.lay("cable", left="10.231.7.1", right="10.231.7.2")
        self.left, self.right = networks.host("left"), networks.host("right")

    def pull(self) -> None:
        ip("-n", self.left, "link", "set", "cable", "down")

    def plug(self) -> None:
        ip("-n", self.left, "link", "set", "cable", "up")


@pytest.fixture
def cable(networks: Networks) -> Cable:
    return Cable(networks)


@pytest.fixture
def member(cable: Cable, system: str, tmp_path: Path) -> Iterator[Callable[..., Member]]:
    started: list[Member] = []

    def start(side: str, name: str, papers: Papers | None = None) -> Member:
        namespace, address = {"left": (cable.left, "10.231.7.1"), "right": (cable.right, "10.231.7.2")}[side]
        tls = None if papers is None else papers.of(name, addresses=[address])
        started.append(Member(namespace, name, f"{address}:0", tmp_path, tls=tls))
        return started[-1]

    yield start
    for running in started:
        running.close()


StartMember = Callable[..., Member]


def test_three_that_start_and_register_at_the_same_moment_all_see_everything(member: StartMember) -> None:
    members = [member("left", "a"), member("left", "b"), member("right", "c")]
    expected = [f"{name}.p{number}.echo" for name in "abc" for number in range(PROVIDERS)]
    for turn in range(ROUNDS):
        for each in members:
            each.tell("join_and_register", str(turn))
        for each in members:
            each.heard()
        for _ in range(2):  # who saw everything first still does when the last one has
            for each in members:
                each.tell("sees", str(len(expected)))
            seen = [each.heard() for each in members]
            assert seen == [expected] * 3, f"round {turn}: {[each.ask('state') for each in members]}"
        called = [each.ask("call_all") for each in members]
        assert called == [len(expected)] * 3, f"round {turn}: {[each.ask('state') for each in members]}"
        for each in members:
            each.ask("stop")


def test_discovery_links_hosts_by_multicast(member: StartMember) -> None:
    left, right = member("left", "a"), member("right", "b")
    for each in (left, right):
        each.ask("start")
        each.ask("register")
    assert len(left.ask("sees", str(PROVIDERS))) == PROVIDERS
    left.ask("find_each_other")
    right.ask("find_each_other")
    assert len(left.ask("sees", str(2 * PROVIDERS))) == 2 * PROVIDERS
    assert right.ask("sees", str(2 * PROVIDERS)) == left.ask("sees", str(2 * PROVIDERS))
    assert left.ask("call_all") == right.ask("call_all") == 2 * PROVIDERS


@pytest.mark.parametrize("certified", [False, True], ids=["password", "certificates"])
@pytest.mark.parametrize("linked_by", ["find_each_other", "connect", "settings"])
def test_services_come_back_after_a_partition_without_a_restart(
    cable: Cable, member: StartMember, tmp_path: Path, linked_by: str, certified: bool
) -> None:
    papers = Papers(tmp_path / "pki") if certified else None
    left, right = member("left", "a", papers), member("right", "b", papers)
    endpoint = left.ask("start")
    right.ask("start", *([endpoint] if linked_by == "settings" else []))
    for each in (left, right):
        each.ask("register")
        if linked_by == "find_each_other":
            each.ask("find_each_other")
    if linked_by == "connect":
        right.ask("connect", endpoint)
    for each in (left, right):
        assert len(each.ask("sees", str(2 * PROVIDERS))) == 2 * PROVIDERS
    for _ in range(2):
        cable.pull()
        for each in (left, right):
            assert len(each.ask("sees", str(PROVIDERS))) == PROVIDERS
        cable.plug()
        for each in (left, right):
            assert len(each.ask("sees", str(2 * PROVIDERS))) == 2 * PROVIDERS
            assert each.ask("call_all") == 2 * PROVIDERS


def test_S05_what_a_client_moves_stops_when_its_link_is_cut(
    cable: Cable,
    benches: Callable[..., Bench],
    run: Callable[..., Program],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TRADE_INSECURE_LAN", "1")
    monkeypatch.setenv("TRADE_CREDENTIALS", "lab:secret")
    monkeypatch.setenv("TRADE_LISTEN", "tcp/10.231.7.1:7447")
    bench = benches(ROSIES_HEAD, inside=cable.left)
    monkeypatch.setenv("TRADE_RUNTIME_DIR", str(tmp_path / "right"))
    monkeypatch.setenv("TRADE_LISTEN", "tcp/10.231.7.2:0")
    monkeypatch.setenv("TRADE_CONNECT", "tcp/10.231.7.1:7447")
    run(MOVER, "call", inside=cable.right).json()
    wait_until(lambda: bool(events(bench.sim.entries(), "motion_started", device_id=1)))
    cut_at = time.monotonic()
    cable.pull()
    bench.stopped_short(cut_at, HALFWAY_RAD)
