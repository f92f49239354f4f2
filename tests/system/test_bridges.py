"""Networks with no way to each other, and what carries between them; and who is linked to whom on one network."""

from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path

import pytest

from tests.support.certificates import Papers
from tests.system.member import PROVIDERS
from tests.system.networks import Member, Networks

StartMember = Callable[..., Member]
pytestmark = pytest.mark.timeout(300)

BRIDGE = "10.231.1.1:7450,10.231.2.1:7450"
LEFT, RIGHT = "tcp/10.231.1.1:7450", "tcp/10.231.2.1:7450"


@pytest.fixture
def member(networks: Networks, system: str, tmp_path: Path) -> Iterator[StartMember]:
    """Starts ``member.py`` on a host; it takes commands and questions from there on."""
    started: list[Member] = []

    def start(host: str, name: str, address: str = "", *, bridge: str = "", tls: Path | None = None) -> Member:
        started.append(Member(networks.host(host), name, address, tmp_path, bridge, tls))
        return started[-1]

    yield start
    for running in started:
        running.close()


@pytest.fixture
def two_networks(networks: Networks) -> None:
    networks.lay("net1", between="10.231.1.1", left1="10.231.1.2", left2="10.231.1.3")
    networks.lay("net2", between="10.231.2.1", right1="10.231.2.2", right2="10.231.2.3")


def up(member: Member, *connect: str) -> Member:
    """Start its container and its providers."""
    member.ask("start", *connect)
    member.ask("register")
    return member


def all_work_together(members: list[Member]) -> None:
    """All containers see and call the services of all."""
    count = PROVIDERS * len(members)
    seen = [each.ask("sees", str(count)) for each in members]
    assert [len(labels) for labels in seen] == [count] * len(members), [each.ask("state") for each in members]
    assert [each.ask("call_all") for each in members] == [count] * len(members)


def test_containers_with_no_way_to_each_other_work_together_through_a_bridge(
    member: StartMember, two_networks: None
) -> None:
    bridge = up(member("between", "bridge", BRIDGE, bridge="net1,net2"))
    left = [up(member(f"left{n}", f"l{n}", f"10.231.1.{n + 1}:0"), LEFT) for n in (1, 2)]
    right = up(member("right1", "r1", "10.231.2.2:0"), RIGHT)
    all_work_together([bridge, *left, right])
    late = up(member("right2", "r2", "10.231.2.3:0"), RIGHT)
    all_work_together([bridge, *left, right, late])
    assert left[0].ask("linked", "2") == sorted(each.ask("id") for each in (bridge, left[1]))
    assert right.ask("linked", "2") == sorted(each.ask("id") for each in (bridge, late))

    left[0].ask("watch")
    right.kill()
    all_work_together([bridge, *left, late])
    assert left[0].ask("gone") == ["r1"] * PROVIDERS


def test_containers_with_certificates_work_together_through_a_bridge_and_strangers_do_not(
    member: StartMember, two_networks: None, tmp_path: Path
) -> None:
    papers, strangers = Papers(tmp_path / "pki"), Papers(tmp_path / "elsewhere")
    left_door, right_door = (endpoint.replace("tcp/", "tls/") for endpoint in (LEFT, RIGHT))

    def of(name: str, *addresses: str) -> Path:
        return papers.of(name, addresses=addresses)

    door = of("door", "10.231.1.1", "10.231.2.1")
    bridge = up(member("between", "bridge", BRIDGE, bridge="net1,net2", tls=door))
    left = [
        up(member(f"left{n}", f"l{n}", f"10.231.1.{n + 1}:0", tls=of(f"l{n}", f"10.231.1.{n + 1}")), left_door)
        for n in (1, 2)
    ]
    right = up(member("right1", "r1", "10.231.2.2:0", tls=of("r1", "10.231.2.2")), right_door)
    foreign = strangers.of("r2", addresses=["10.231.2.3"])
    stranger = up(member("right2", "r2", "10.231.2.3:0", tls=foreign), right_door)
    all_work_together([bridge, *left, right])
    assert left[0].ask("linked", "2") == sorted(each.ask("id") for each in (bridge, left[1]))
    all_work_together([stranger])


def test_when_a_bridge_dies_neighbours_work_on_and_the_far_come_back_with_the_next_one(
    member: StartMember, two_networks: None
) -> None:
    first = member("between", "bridge", BRIDGE, bridge="net1,net2")
    first.ask("start")
    left = [up(member(f"left{n}", f"l{n}", f"10.231.1.{n + 1}:0"), LEFT) for n in (1, 2)]
    right = up(member("right1", "r1", "10.231.2.2:0"), RIGHT)
    all_work_together([*left, right])
    left[0].ask("keep", "r1")
    for _ in range(2):
        left[0].ask("nap", "r1")
        first.kill()
        with pytest.raises(AssertionError, match=r"^ContainerLost"):
            left[0].ask("woken")
        all_work_together(left)
        all_work_together([right])
        with pytest.raises(AssertionError, match=r"^ServiceGone"):
            left[0].ask("use")

        first = member("between", "bridge", BRIDGE, bridge="net1,net2")
        first.ask("start")
        all_work_together([*left, right])
        assert left[0].ask("use") == 3


def test_containers_on_the_host_of_the_bridge_take_part_in_any_start_order(
    member: StartMember, two_networks: None
) -> None:
    early = up(member("between", "early"))
    bridge = up(member("between", "bridge", BRIDGE, bridge="net1,net2"))
    left = up(member("left1", "l1", "10.231.1.2:0"), LEFT)
    right = up(member("right1", "r1", "10.231.2.2:0"), RIGHT)
    late = up(member("between", "late"))
    all_work_together([early, bridge, left, right, late])


def test_private_networks_dial_out_and_messages_cross_two_bridges_in_a_row(
    networks: Networks, member: StartMember
) -> None:
    networks.lay("private", robot="10.231.1.1", arm="10.231.1.2")
    networks.lay("public", robot="10.231.2.1", office="10.231.2.2", laptop="10.231.2.3")
    networks.lay("inner", office="10.231.3.1", desk="10.231.3.2")
    office = member("office", "office", "10.231.2.2:7450,10.231.3.1:7450", bridge="public,inner")
    office.ask("start")
    # The robot listens on its private side only: no container can dial it from outside. So does the laptop.
    robot = up(member("robot", "robot", "10.231.1.1:7450", bridge="private"), "tcp/10.231.2.2:7450")
    arm = up(member("arm", "arm", "10.231.1.2:0"), "tcp/10.231.1.1:7450")
    desk = up(member("desk", "desk", "10.231.3.2:0"), "tcp/10.231.3.1:7450")
    laptop = up(member("laptop", "laptop", bridge="lo"), "tcp/10.231.2.2:7450")
    guest = up(member("laptop", "guest"))
    single = up(member("laptop", "single"), "tcp/10.231.2.2:7450")
    all_work_together([robot, arm, desk, laptop, guest, single])

    office.kill()
    all_work_together([robot, arm])
    all_work_together([laptop, guest])
    office = member("office", "office", "10.231.2.2:7450,10.231.3.1:7450", bridge="public,inner")
    office.ask("start")
    all_work_together([robot, arm, desk, laptop, guest, single])


def test_S12_a_bridge_further_away_that_opens_again_ends_no_lock(networks: Networks, member: StartMember) -> None:
    """The container that granted it keeps its own bridge, and loses sight of the owner's only."""
    networks.lay("private", robot="10.231.1.1", arm="10.231.1.2")
    networks.lay("public", robot="10.231.2.1", office="10.231.2.2")
    networks.lay("inner", office="10.231.3.1", desk="10.231.3.2")
    office = member("office", "office", "10.231.2.2:7450,10.231.3.1:7450", bridge="public,inner")
    office.ask("start")
    robot = member("robot", "robot", "10.231.1.1:7450", bridge="private")
    robot.ask("start", "tcp/10.231.2.2:7450")
    arm = member("arm", "arm", "10.231.1.2:0")
    arm.ask("start", "tcp/10.231.1.1:7450")
    arm.ask("register_one", "rosie.arm.p0")
    desk = member("desk", "desk", "10.231.3.2:0")
    desk.ask("start", "tcp/10.231.3.1:7450")
    desk.ask("group", "rosie.arm.p0", "arm")
    desk.ask("hold", "rosie.arm.p0")
    for _ in range(3):
        office.ask("reopen")
        desk.ask("group", "rosie.arm.p0", "arm")
        assert desk.ask("held")


def test_a_bridge_and_its_neighbours_are_linked_while_they_run(member: StartMember, two_networks: None) -> None:
    bridge = up(member("between", "bridge", BRIDGE, bridge="net1,net2"))
    left = up(member("left1", "l1", "10.231.1.2:0"))
    right = member("right1", "r1", "10.231.2.2:0")
    dialled = right.ask("start")
    right.ask("register")
    left.ask("connect", LEFT)
    bridge.ask("connect", dialled)
    all_work_together([bridge, left, right])

    second = member("left2", "second", "0.0.0.0:7450", bridge="net1,lo")
    second.ask("start")
    with pytest.raises(AssertionError, match=r"^CannotConnect: .* bridges link to each other by connect in their sett"):
        second.ask("connect", LEFT)


@pytest.mark.parametrize("linked", [True, False])
def test_when_one_of_two_parallel_bridges_dies_no_call_runs_twice(
    networks: Networks, member: StartMember, linked: bool
) -> None:
    networks.lay("net1", first="10.231.1.1", second="10.231.1.2", left="10.231.1.3")
    networks.lay("net2", first="10.231.2.1", second="10.231.2.2", right="10.231.2.3")
    first = member("first", "first", "10.231.1.1:7450,10.231.2.1:7450", bridge="net1,net2")
    second = member("second", "second", "10.231.1.2:7450,10.231.2.2:7450", bridge="net1,net2")
    first.ask("start")
    second.ask("start", *(["tcp/10.231.1.1:7450"] if linked else []))
    left = up(member("left", "l", "10.231.1.3:0"), "tcp/10.231.1.1:7450", "tcp/10.231.1.2:7450")
    right = up(member("right", "r", "10.231.2.3:0"), "tcp/10.231.2.1:7450", "tcp/10.231.2.2:7450")
    right.ask("register_one", "arm")
    for each in (left, right):
        each.ask("linked", "2")
    for each in (first, second):
        each.ask("linked", "3" if linked else "2")
    assert len(left.ask("sees", str(2 * PROVIDERS + 1))) == 2 * PROVIDERS + 1
    left.ask("watch")
    left.ask("move", "arm", "200")
    assert right.ask("moved", "arm") == list(range(200))
    first.kill()
    left.ask("linked", "1")
    left.ask("move", "arm", "200")
    assert right.ask("moved", "arm") == [*range(200), *range(200)]
    assert left.ask("gone") == []


@pytest.mark.parametrize(
    ("bridge", "listen", "problem"),
    [
        ("net1,net9", BRIDGE, "bridge net9: this host has no such interface, or not yet; it has .*net1, net2"),
        (
            "net1,net2",
            "10.231.1.1:7450",
            "bridge net2: nothing listens on it, only on tcp/10.231.1.1:7450; add an address of net2 to TRADE_",
        ),
        ("net1,net2", "", r"bridge net1: nothing listens on it, only on tcp/127.0.0.1:\d+; add an address of"),
        ("net1", BRIDGE, "bridge net1: joins networks, and this is only one; name a second interface, or connect"),
    ],
)
def test_a_bridge_that_cannot_join_its_networks_says_what_to_do(
    member: StartMember, two_networks: None, bridge: str, listen: str, problem: str
) -> None:
    refused = member("between", "bridge", listen, bridge=bridge)
    with pytest.raises(AssertionError, match=f"^ConfigurationError: {problem}"):
        refused.ask("start")


def test_a_bridge_may_listen_on_all_networks_of_its_host(member: StartMember, two_networks: None) -> None:
    bridge = up(member("between", "bridge", "0.0.0.0:7450", bridge="net1,net2"))
    left = up(member("left1", "l1", "10.231.1.2:0"), LEFT)
    right = up(member("right1", "r1", "10.231.2.2:0"), RIGHT)
    all_work_together([bridge, left, right])


def test_all_containers_on_one_network_are_linked_to_each_other(networks: Networks, member: StartMember) -> None:
    networks.lay("net", left="10.231.1.1", right="10.231.1.2")
    # Two of them can dial, but not be dialled.
    members = [
        up(member("left", "a", "10.231.1.1:7450")),
        *(up(member("left", name, "10.231.1.1:0"), "tcp/10.231.1.1:7450") for name in "bc"),
        up(member("right", "d", "10.231.1.2:0"), "tcp/10.231.1.1:7450"),
        *(up(member("right", name), "tcp/10.231.1.1:7450") for name in "ef"),
    ]
    links = {frozenset((each.ask("id"), other)) for each in members for other in each.ask("linked", "5")}
    assert links == {frozenset(pair) for pair in combinations([each.ask("id") for each in members], 2)}
    all_work_together(members)


def test_a_group_spans_two_hosts_grows_and_shrinks(networks: Networks, member: StartMember) -> None:
    networks.lay("net", left="10.231.1.1", right="10.231.1.2")
    left, right = member("left", "l", "10.231.1.1:7450"), member("right", "r", "10.231.1.2:0")
    left.ask("start")
    right.ask("start", "tcp/10.231.1.1:7450")
    both = (left, right)
    on_left, on_right = [networks.host("left"), "rosie.neck.echo"], [networks.host("right"), "rosie.arm.echo"]

    left.ask("register_one", "rosie.neck")
    assert [each.ask("group", "rosie", "l") for each in both] == [[on_left]] * 2
    right.ask("register_one", "rosie.arm")
    assert [each.ask("group", "rosie", "l", "r") for each in both] == [[on_right, on_left]] * 2
    assert [each.ask("call_group", "rosie") for each in both] == [[7, 7]] * 2

    right.ask("register_one", "shelf")
    right.ask("add_group", "shelf", "rosie")
    shelf = [networks.host("right"), "shelf.echo"]
    assert [each.ask("group", "rosie", "l", "r", "r") for each in both] == [[on_right, on_left, shelf]] * 2
    right.ask("remove_group", "shelf", "rosie")
    assert [each.ask("group", "rosie", "l", "r") for each in both] == [[on_right, on_left]] * 2
    left.ask("deregister_one", "rosie.neck")
    assert [each.ask("group", "rosie", "r") for each in both] == [[on_right]] * 2
    right.kill()
    assert left.ask("group", "rosie") == []
