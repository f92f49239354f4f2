"""``trade gateway`` between networks: what crosses, what does not, and what becomes of it on bad days."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from tests.system.networks import Member, Networks
from tests.system.sites import Site

pytestmark = pytest.mark.timeout(300)

POLICY = policy_text(
    "chief=chief arm=driver planner=operator dash=viewer",
    head='gateways = ["door"]\n',
    driver="register=rosie,cellar read=lobby",
    operator="read=* call=rosie lock=rosie register=lobby",
    viewer="read=*",
    chief="read=* administer=trade",
)


@pytest.fixture
def site(networks: Networks, tmp_path: Path) -> Iterator[Site]:
    made = Site(networks, tmp_path, POLICY)
    yield made
    made.close()


@pytest.fixture
def arm(site: Site) -> Member:
    """On the private network: two groups, one of which is let out."""
    made = site.member("left", "arm")
    made.ask("register_one", "rosie.arm")
    made.ask("register_one", "cellar")
    return made


@pytest.fixture
def planner(site: Site, arm: Member) -> Member:
    made = site.member("right", "planner")
    made.ask("group", "rosie.arm", "arm")
    return made


def test_an_exported_service_is_found_called_and_locked_on_the_other_side_and_reported_gone(
    site: Site, arm: Member, planner: Member
) -> None:
    assert site.ready["networks"] == {"net1": ["rosie.arm"], "net2": []}
    assert planner.ask("call_group", "rosie.arm") == [7]
    planner.ask("move", "rosie.arm", "3")
    assert arm.ask("moved", "rosie.arm") == [0, 1, 2]
    assert len(planner.ask("lock", "rosie.arm")) == 1
    assert planner.ask("sees", "1") == ["rosie.arm.echo"]  # nothing of the cellar
    planner.ask("watch")
    arm.kill()
    wait_until(lambda: planner.ask("gone") == ["arm"], "its end crosses, too")


def test_a_service_is_visible_and_callable_only_once_it_is_exported(site: Site, arm: Member, planner: Member) -> None:
    planner.ask("register_one", "lobby")
    assert planner.ask("sees", "2") == ["lobby.echo", "rosie.arm.echo"]
    planner.ask("move", "rosie.arm", "1")  # what was said before it has arrived
    assert arm.ask("sees", "2") == ["cellar.echo", "rosie.arm.echo"]
    site.change(site.file, "export = []", 'export = ["lobby"]')
    assert [label for _, label in arm.ask("group", "lobby", "planner")] == ["lobby.echo"]
    assert planner.ask("sees", "2") == ["lobby.echo", "rosie.arm.echo"]
    site.change(site.file, 'export = ["lobby"]', "export = []")
    assert arm.ask("sees", "2") == ["cellar.echo", "rosie.arm.echo"]
    site.change(site.file, "export = []", 'export = ["lobby"]')
    assert arm.ask("sees", "3") == ["cellar.echo", "lobby.echo", "rosie.arm.echo"]


def test_an_unauthorized_call_is_refused_by_the_caller_the_callee_and_the_gateway(
    site: Site, arm: Member, planner: Member
) -> None:
    planner.ask("move", "rosie.arm", "1")
    dash = site.member("right2", "dash")
    dash.ask("group", "rosie.arm", "arm")
    assert dash.ask("call_group", "rosie.arm") == [7]
    assert dash.refused("move", "rosie.arm", "1").startswith("AccessDenied")
    lenient = site.folder / "lenient.toml"
    lenient.write_text(POLICY.replace('dash = ["viewer"]', 'dash = ["operator"]'))
    dash.close()
    liar = site.member("right2", "dash", policy=lenient)  # goes by a policy of its own
    liar.ask("group", "rosie.arm", "arm")
    assert liar.refused("move", "rosie.arm", "1").startswith("AccessDenied")  # the callee's word
    stranger = site.member("right2", "mallory", policy=lenient)  # has a certificate, and no role anywhere
    stranger.ask("sees", "0")
    assert stranger.ask("call_all") == 0
    assert arm.ask("moved", "rosie.arm") == [0]


def test_a_policy_can_be_changed_while_calls_run(site: Site, arm: Member, planner: Member) -> None:
    planner.ask("try_move", "rosie.arm", "20")
    site.change(site.policy, 'planner = ["operator"]', "planner = []")
    site.gateway.send_signal(signal.SIGHUP)
    wait_until(lambda: "move" not in str(_tried(planner)), "the gateway lets it through no more")
    site.change(site.policy, "planner = []", 'planner = ["operator"]')
    planner.ask("group", "rosie.arm", "arm")
    wait_until(lambda: _tried(planner) == "moved", "and again")


def _tried(member: Member) -> str:
    member.tell("try_move", "rosie.arm", "1")
    said = member.says()
    return "moved" if "answer" in said else said["error"].partition(":")[0]


def test_a_wrong_file_changes_nothing_and_says_why(site: Site, planner: Member) -> None:
    site.change(site.file, 'policy = "policy.toml"', 'polcy = "policy.toml"')
    wait_until(lambda: "polcy: unknown key" in site.complaints(), "it is said")
    assert "continuing as before" in site.complaints()
    planner.ask("move", "rosie.arm", "2")
    site.change(site.file, 'polcy = "policy.toml"', 'policy = "policy.toml"\nconnect = ["tcp/10.231.2.9:1"]')
    wait_until(lambda: "must be tls/10.231.2.9:1" in site.complaints(), "so is this")
    planner.ask("move", "rosie.arm", "1")


def test_a_file_with_its_interfaces_swapped_starts_nothing(site: Site) -> None:
    """Else `left`, which exports one group, would be taken for `right`, and the other way round."""
    swapped = (
        site.file.read_text().replace('"net1"', '"other"').replace('"net2"', '"net1"').replace('"other"', '"net2"')
    )
    site.end(signal.SIGTERM)
    site.file.write_text(swapped)
    for more in ([], ["--check"]):
        command = ["ip", "netns", "exec", site.networks.host("between"), sys.executable, "-m", "trade_gateway"]
        ended = subprocess.run(
            [*command, "gateway", str(site.file), *more], capture_output=True, text=True, timeout=60, check=False
        )
        assert ended.returncode == 1
        assert "network.private.listen: tls/10.231.1.1:7450 is an address of net1 on this host" in ended.stderr


def test_S12_a_gateway_that_reloads_loses_no_client_call_or_lock(site: Site, arm: Member, planner: Member) -> None:
    arm.ask("register_one", "rosie.arm.p0")
    planner.ask("group", "rosie.arm.p0", "arm")
    planner.ask("watch")
    planner.ask("hold", "rosie.arm.p0")
    planner.ask("nap", "rosie.arm")
    for exported in ('["lobby"]', "[]", '["lobby"]'):
        site.change(site.file, site.file.read_text().rpartition("export = ")[2], f"{exported}\n")
        assert site.said()["reloaded"]
    planner.ask("woken")
    assert planner.ask("held")
    assert planner.ask("gone") == []
    assert planner.ask("sees", "2") == ["rosie.arm.echo", "rosie.arm.p0.echo"]


def test_a_stream_crosses_at_the_rate_of_its_export(site: Site, arm: Member, planner: Member) -> None:
    arm.ask("register_ticker", "rosie.arm")
    near = site.member("left", "chief")
    near.ask("listen", "rosie.arm", "200")
    planner.ask("listen", "rosie.arm", "200")
    assert planner.ask("rate") == 200
    site.change(site.file, 'export = ["rosie.arm"]', 'export = ["rosie.arm"]\nstream_hz = 20.0')
    assert site.said()["reloaded"]
    wait_until(lambda: planner.ask("rate") == 20, "it asks for no more than comes through")
    planner.ask("skip")
    planner.ask("overhear", "rosie.arm", "200")  # which the one nearby is given at this moment
    near.ask("heard", "100")
    (first, first_number, _), *others = planner.ask("heard", "20")
    last, last_number, _ = others[-1]
    assert last - first > 5 * len(others)  # of ten that are taken one crosses
    assert sum(dropped + 1 for _, _, dropped in others) == last_number - first_number
    assert sum(dropped for _, _, dropped in others) < len(others)  # what is not put for it is not missing
    assert planner.ask("tapped") == []
    site.change(site.file, "stream_hz = 20.0", "")
    assert site.said()["reloaded"]
    wait_until(lambda: planner.ask("rate") == 200, "and follows when more does")
    planner.ask("skip")
    planner.ask("heard", "1")


def test_a_gateway_that_is_killed_ends_the_calls_under_way_and_the_next_one_serves(
    site: Site, arm: Member, planner: Member
) -> None:
    planner.ask("watch")
    planner.ask("started", "nap", "rosie.arm", "60.0")
    planner.ask("call", "move", "rosie.arm", "arm", "1")
    site.end(signal.SIGKILL)
    assert planner.refused("ended").startswith("ContainerLost")
    wait_until(lambda: planner.ask("gone") == ["arm"], "out of sight")
    planner.refused("call", "move", "rosie.arm", "arm", "2")
    site.begin()
    planner.ask("group", "rosie.arm", "arm")
    planner.ask("call", "move", "rosie.arm", "arm", "3")
    assert arm.ask("moved", "rosie.arm") == [1, 3]


def test_a_gateway_that_is_terminated_leaves_in_order(site: Site) -> None:
    chief = site.member("right", "chief")
    name = str(site.ready["container"])
    assert chief.ask("call", "terminate_container", "trade", name, '"walled_up"') == []
    assert site.gateway.wait(20) == 0
    assert f"container {name} is terminated by chief: walled_up" in site.complaints()
