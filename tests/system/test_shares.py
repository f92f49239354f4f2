"""``trade gateway`` between two systems, each with an authority, a policy and a network of its own."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.certificates import Papers
from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from tests.system.networks import Member, Networks
from tests.system.sites import GatewayHost

pytestmark = [pytest.mark.timeout(300)]

LAB = policy_text(
    "arm=driver planner=operator door=operator",
    driver="register=rosie,cellar",
    operator="read=* call=rosie lock=rosie administer=rosie",
)
CLINIC = policy_text(
    "guest=guest anna=nurse paul=visitor",
    guest="register=rosie",
    nurse="read=* call=rosie lock=rosie",
    visitor="read=rosie",
)
GATEWAY = """
system = "lab-0"
tls = "lab/pki/issued/door"
policy = "lab/policy.toml"

[network.robot]
interface = "net1"
listen = ["tls/10.231.1.1:7450"]

[share.clinic]
system = "clinic-0"
tls = "clinic/pki/issued/guest"
policy = "clinic/policy.toml"
listen = ["tls/10.231.2.1:7450"]
export = ["rosie.arm"]
"""


class Sites(GatewayHost):
    """A laboratory with a robot and a clinic; one host has a foot in both networks."""

    def __init__(self, networks: Networks, folder: Path) -> None:
        self.networks = networks
        self.folder = folder
        self.file = folder / "gateway.toml"
        self.file.write_text(GATEWAY)
        self.papers: dict[str, Papers] = {}
        for system, policy in (("lab", LAB), ("clinic", CLINIC)):
            (folder / system).mkdir()
            (folder / system / "policy.toml").write_text(policy)
            self.papers[system] = Papers(folder / system / "pki")
        self.members: list[Member] = []
        networks.lay("net1", between="10.231.1.1", left="10.231.1.2")
        networks.lay("net2", between="10.231.2.1", right="10.231.2.2", right2="10.231.2.3")
        self.papers["lab"].of("door", addresses=["10.231.1.1"], purpose="gateway")
        self.papers["clinic"].of("guest", addresses=["10.231.2.1"])
        self.begin()

    def member(self, system: str, host: str, name: str, network: int, papers: str = "") -> Member:
        own = self.folder / f"{name}.toml"
        own.write_text((self.folder / system / "policy.toml").read_text())
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("TRADE_SYSTEM", system)  # member.py appends its turn
            tls = self.papers[papers or system].of(name)
            runtime = self.folder / "runtime"
            made = Member(self.networks.host(host), name, "127.0.0.1:0", runtime, tls=tls, policy=own)
        self.members.append(made)
        made.ask("start", f"tls/10.231.{network}.1:7450")
        return made

    def change(self, before: str, after: str) -> None:
        text = self.file.read_text()
        assert before in text
        self.file.write_text(text.replace(before, after))
        assert self.said()["reloaded"]


@pytest.fixture
def sites(networks: Networks, tmp_path: Path) -> Iterator[Sites]:
    made = Sites(networks, tmp_path)
    yield made
    made.close()


@pytest.fixture
def arm(sites: Sites) -> Member:
    """In the laboratory: two groups, one of which is shared."""
    made = sites.member("lab", "left", "arm", 1)
    made.ask("register_one", "rosie.arm")
    made.ask("register_one", "cellar")
    return made


@pytest.fixture
def anna(sites: Sites, arm: Member) -> Member:
    made = sites.member("clinic", "right", "anna", 2)
    made.ask("group", "rosie.arm", "gateway")
    return made


def test_what_is_shared_is_found_called_and_locked_from_another_system(sites: Sites, arm: Member, anna: Member) -> None:
    shared = {"clinic": {"system": "clinic-0", "identity": "guest", "export": ["rosie.arm"], "import": []}}
    assert sites.ready["shares"] == {"clinic": {**shared["clinic"], "listen": ["tls/10.231.2.1:7450"]}}
    assert anna.ask("sees", "1") == ["rosie.arm.echo"]  # nothing of the cellar
    assert anna.ask("call_group", "rosie.arm") == [7]
    anna.ask("move", "rosie.arm", "3")
    assert arm.ask("moved", "rosie.arm") == [0, 1, 2]
    planner = sites.member("lab", "left", "planner", 1)
    planner.ask("group", "rosie.arm", "arm")
    anna.ask("hold", "rosie.arm")
    refused = planner.refused("move", "rosie.arm", "1")
    assert refused.startswith("LockedByOther")
    assert "clinic-0/anna via door" in refused
    anna.kill()  # with her lock
    wait_until(lambda: planner.ask("lock", "rosie.arm"), "her lock falls")


def test_each_system_decides_about_its_own(sites: Sites, arm: Member, anna: Member) -> None:
    spy = sites.member("clinic", "right2", "spy", 2, papers="lab")  # has no certificate of the clinic
    paul = sites.member("clinic", "right2", "paul", 2)
    paul.ask("group", "rosie.arm", "gateway")
    assert paul.ask("call_group", "rosie.arm") == [7]
    assert paul.refused("move", "rosie.arm", "1").startswith("AccessDenied")
    assert spy.ask("sees", "0") == []  # in the time in which paul found it
    own = sites.folder / "lab" / "policy.toml"
    own.write_text(LAB.replace('door = ["operator"]', "door = []"))
    assert sites.said()["reloaded"]
    anna.ask("group", "rosie.arm", "gateway")
    refused = anna.refused("move", "rosie.arm", "1")
    assert refused.startswith("AccessDenied")
    assert "door" in refused
    assert arm.ask("moved", "rosie.arm") == []


def test_a_changed_list_takes_effect_while_calls_run(sites: Sites, arm: Member, anna: Member) -> None:
    arm.ask("register_one", "rosie.arm.p0")
    anna.ask("group", "rosie.arm.p0", "gateway")
    anna.ask("watch")
    anna.ask("hold", "rosie.arm.p0")
    sites.change('export = ["rosie.arm"]', 'export = ["rosie.arm.p0", "cellar"]')
    assert [label for _, label in anna.ask("group", "rosie.arm", "gateway")] == ["rosie.arm.p0.echo"]
    assert anna.ask("held")
    assert anna.ask("gone") == ["gateway"]
    assert anna.ask("sees", "1") == ["rosie.arm.p0.echo"]  # the guest may not offer the cellar there


def test_a_gateway_that_is_killed_takes_its_clients_locks_along_and_is_used_again(
    sites: Sites, arm: Member, anna: Member
) -> None:
    planner = sites.member("lab", "left", "planner", 1)
    planner.ask("group", "rosie.arm", "arm")
    anna.ask("hold", "rosie.arm")
    anna.ask("watch")
    sites.end(signal.SIGKILL)
    wait_until(lambda: anna.ask("gone") == ["gateway"], "out of sight")
    planner.ask("lock", "rosie.arm")
    sites.begin()
    anna.ask("group", "rosie.arm", "gateway")
    anna.ask("move", "rosie.arm", "1")
    assert arm.ask("moved", "rosie.arm") == [1, 0]
