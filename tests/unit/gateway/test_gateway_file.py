"""Gateway files: a right file is accepted, and each mistake is named with its remedy before anything starts."""

import os
import queue
import shutil
import signal
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from socket import AF_INET, AF_INET6, AF_PACKET
from types import SimpleNamespace

import psutil
import pytest
from typer.testing import CliRunner

from tests.support.certificates import Papers
from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from trade import Container
from trade._security.certificates import Certificate
from trade.errors import ConfigurationError
from trade.transport.endpoints import loopback_interface
from trade_gateway.cli import app
from trade_gateway.cli.robots import _gateway
from trade_gateway.cli.robots._file_changes import FileDigests, digest, named_by
from trade_gateway.config import _gateway_file
from trade_gateway.config._children import Child
from trade_gateway.config._gateway_file import read_gateway_file
from trade_gateway.pki._authority import Authority
from trade_gateway.process._addresses import addresses, forwarding
from trade_gateway.terminal._output import Output

pytestmark = pytest.mark.virtual_time

EXAMPLE = Path(__file__).parents[3] / "examples" / "gateway.toml"
POLICY = policy_text("planner=viewer", head='revoked_file = "revoked.toml"\ngateways = ["door"]\n', viewer="read=*")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The example, with what it names beside it."""
    made = tmp_path / "gateway.toml"
    made.write_text(EXAMPLE.read_text())
    (tmp_path / "policy.toml").write_text(POLICY)
    (tmp_path / "revoked.toml").write_text("revoked = []")
    Papers(tmp_path / "pki").of("door", purpose="gateway", addresses=["192.168.7.1", "10.0.0.7"])
    return made


def change(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


def test_the_example_is_right_and_says_what_crosses(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_SYSTEM", "another")  # the file says it all
    monkeypatch.setenv("TRADE_CONNECT", "tcp/127.0.0.1:1")
    settings = read_gateway_file(file).settings
    assert (settings.system, settings.container, settings.identity) == ("lab", "gateway", "door")
    assert settings.listen == ("tls/192.168.7.1:7450", "tls/10.0.0.7:7450")
    assert settings.bridge == ("eth0", "eth1")
    assert settings.exports == {"eth0": ("rosie",), "eth1": ()}
    assert settings.connect == ()


@pytest.mark.realtime
def test_a_gateway_may_be_the_hub_of_its_host_and_is_not_by_itself(
    tmp_path: Path, start_container: Callable[..., Container]
) -> None:
    lab = 'credentials = "lab:secret"\ninsecure_lan = true\n'
    file = tmp_path / "hub.toml"
    file.write_text(f'system = "{os.environ["TRADE_SYSTEM"]}"\n{lab}[network.here]\ninterface = "lo"\n')
    with pytest.raises(ConfigurationError, match="bridge lo: joins networks, and this is only one"):
        read_gateway_file(file)
    change(file, "insecure_lan", "hub = true\ninsecure_lan")
    plan = read_gateway_file(file)
    running = _gateway.Gateway(file, plan, named_by(file, plan), lambda: None)
    try:
        attached = [start_container(name, credentials=("lab", "secret")) for name in "ab"]
        assert {one.reach.source for one in attached} == {"the hub of this host"}
        wait_until(lambda: len(attached[0].addresses()) == 3)
        before = running.container.address
        assert running.reload(file, Output(as_json=True))
        wait_until(lambda: before not in attached[0].addresses() and len(attached[0].addresses()) == 3)
    finally:
        running.close()


def test_the_commands_in_the_example_make_all_that_it_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("gateway.toml", "policy.toml"):
        (tmp_path / name).write_text(EXAMPLE.with_name(name).read_text())
    monkeypatch.chdir(tmp_path)
    commands = [
        line.removeprefix("#     trade ").split() for line in EXAMPLE.read_text().splitlines() if "#     trade " in line
    ]
    said = [CliRunner().invoke(app, words, catch_exceptions=False).stdout for words in commands]
    assert len(said) == 3 and "gateway.toml is right" in said[-1]


def test_a_gateway_that_its_policy_does_not_name_is_reported(file: Path) -> None:
    change(file.parent / "policy.toml", 'gateways = ["door"]', 'gateways = ["other"]')
    assert read_gateway_file(file).settings  # it continues, as it did before
    with pytest.raises(ConfigurationError, match=r'door.*gateways = \["other", "door"\]'):
        CliRunner().invoke(app, ["gateway", str(file), "--check"], catch_exceptions=False)


def test_a_policy_that_is_being_written_when_the_gateway_is_up_does_not_end_it(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Up:
        """A gateway on interfaces that this host does not have."""

        news: "queue.SimpleQueue[object]" = queue.SimpleQueue()
        healthy = True
        container = SimpleNamespace(settings=SimpleNamespace(container="gateway", system="lab", identity="door"))

        def __init__(self, *_: object) -> None: ...

        def reload(self, *_: object, **__: object) -> bool:
            return True

        def close(self) -> None: ...

    def say_ready(*_: object) -> None:
        (file.parent / "policy.toml").write_text("")
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(_gateway, "Gateway", Up)
    monkeypatch.setattr(_gateway, "_say_ready", say_ready)
    reported = CliRunner().invoke(app, ["gateway", str(file)])
    assert (reported.exit_code, reported.exception) == (0, None), reported.output
    assert "leaving" in reported.stdout


def test_without_any_list_everything_crosses_and_with_one_the_rest_does(file: Path) -> None:
    change(file, 'export = ["rosie"]', "")
    assert read_gateway_file(file).settings.exports == {"eth0": ("*",), "eth1": ()}
    change(file, "export = []", "")
    assert read_gateway_file(file).settings.exports is None


ALONE = 'system = "lab"\n'
EYES = '[container.eyes]\nproviders = [{ class = "sight:Eye" }]\n'


def test_a_file_may_have_nothing_but_containers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_CREDENTIALS", "an:other")
    file = tmp_path / "gateway.toml"
    file.write_text(f'{ALONE}{EYES}after = ["mind"]\n[container.mind]\nproviders = []\nrestarts = 2\n')
    plan = read_gateway_file(file)
    assert [child.name for child in plan.children] == ["mind", "eyes"]
    mind, eyes = plan.children
    assert (mind.terms.restarts, eyes.terms.restarts, eyes.terms.restart) == (2, 10, "always")
    assert " ".join(eyes.part.words) == "--system lab container --name eyes --allow sight:Eye"
    assert "TRADE_CREDENTIALS" not in eyes.environment  # the file says it all
    assert (plan.settings.bridge, plan.settings.system) == ((), "lab")
    said = CliRunner().invoke(app, ["gateway", str(file), "--check"]).stdout.splitlines()
    assert said[1:] == ["  it keeps mind up: providers", "  it keeps eyes up: providers"]


def test_containers_are_let_in_as_the_gateway_is(tmp_path: Path) -> None:
    file = tmp_path / "gateway.toml"
    file.write_text(f'{ALONE}insecure_lan = true\ncredentials = "a:b"\n{EYES}')
    [eyes] = read_gateway_file(file).children
    assert eyes.part.environment["TRADE_CREDENTIALS"] == "a:b"
    assert eyes.part.environment["TRADE_INSECURE_LAN"] == "1"


def test_a_container_starts_again_only_for_what_starts_it(tmp_path: Path) -> None:
    file = tmp_path / "gateway.toml"

    def read(more: str) -> Child:
        file.write_text(f"{ALONE}{EYES}{more}")
        return read_gateway_file(file).children[0]

    before = read("")
    assert before.starts_like(read("restarts = 3\nwindow_s = 5\nsave_every_s = 2\n"))
    assert not before.starts_like(read('allow = ["a:*"]\n'))
    assert not before.starts_like(read('lease_from = "base"\n'))
    assert not before.starts_like(read('connect = ["tcp/127.0.0.1:7450"]\n'))


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("hots = 1\n", 4, "unknown key 'hots'; there is host"),
        ('restart = "sometimes"\n', 4, "restart"),
        ("restarts = -1\n", 4, ">= 0"),
        ("answers_within_s = 0.0\n", 4, ">= 0.2"),
        ('host = "far"\n', 4, "a gateway supervises containers of its own host; leave it out"),
        ('after = ["missing"]\n', 4, "there is no container 'missing'; there is eyes"),
        ('rules = "care.toml"\n', 4, "there is providers and rules"),
        ('lease_from = "base"\nstands_in_for = "base"\n', 4, "leave one of them out"),
        ("lease_s = 5.0\n", 4, "goes with stands_in_for; leave it out"),
        ("move_above = 0.8\n", 4, "goes with stands_in_for; leave it out"),
        ('lease_from = "base"\nmove_above = 0.8\n', 5, "is set in the file of base; leave it out"),
        ('stands_in_for = ["rover"]\nmove_above = 80\n', 5, "<= 1"),
        ('stands_in_for = ["rover", "rover"]\n', 4, "names rover twice"),
        ('lease_from = "base"\nlease_s = 5.0\n', 5, "is set in the file of base; leave it out"),
        ('stands_in_for = "rover"\nlease_s = 1.0\n', 5, ">= 2"),
        ('lease_from = "base"\nrestart = "never"\n', 5, "does not go with lease_from"),
        ('[container.care]\nrules = "care.toml"\nlease_from = "base"\n', 6, "a rules is pinned to its host"),
        ('[container.rosie]\nrobot = "missing.toml"\nstands_in_for = "rover"\n', 6, "a robot is pinned to its host"),
        ('[container.door]\ngateway = "door.toml"\n', 5, "is this file"),
        ('[container.rosie]\nrobot = "missing.toml"\n', 5, "there is no such file"),
    ],
)
def test_each_mistake_in_a_container_is_named_with_its_line(tmp_path: Path, text: str, line: int, said: str) -> None:
    file = tmp_path / "gateway.toml"
    file.write_text(f"{ALONE}{EYES}{text}")
    with pytest.raises(ConfigurationError) as wrong:
        read_gateway_file(file)
    assert str(wrong.value).startswith(f"{file}:{line}: container.")
    assert said in str(wrong.value)


def test_with_certificates_each_container_has_its_own(file: Path) -> None:
    file.write_text(f"{file.read_text()}{EYES}")
    with pytest.raises(ConfigurationError, match=r"container\.eyes\.tls: missing; .* trade pki issue eyes"):
        read_gateway_file(file)
    Papers(file.parent / "more").of("eyes")
    file.write_text(f'{file.read_text()}tls = "more/issued/eyes"\n')
    [eyes] = read_gateway_file(file).children
    assert eyes.part.environment["TRADE_TLS"] == str(file.parent / "more/issued/eyes")
    assert eyes.part.environment["TRADE_POLICY"] == str(file.parent / "policy.toml")


LIMIT = "# stream_hz = 50.0"
"""In the example, as a comment."""


@pytest.mark.parametrize(
    ("written", "limits"),
    [
        ("stream_hz = 20.0", {"rosie": 20}),
        ("stream_hz = { rosie = 5 }", {"rosie": 5}),
        ("", {}),
    ],
)
def test_streams_are_limited_by_group_or_all_alike(file: Path, written: str, limits: dict[str, float]) -> None:
    change(file, LIMIT, f"{written} #")
    assert read_gateway_file(file).settings.stream_hz == {"eth0": limits, "eth1": {}}


def test_streams_of_all_are_limited_where_no_groups_are_named(file: Path) -> None:
    change(file, 'export = ["rosie"]', "stream_hz = 100")
    change(file, "export = []", "")
    settings = read_gateway_file(file).settings
    assert (settings.exports, settings.stream_hz["eth0"]) == ({"eth0": ("*",), "eth1": ("*",)}, {"*": 100})
    reported = CliRunner().invoke(app, ["gateway", str(file), "--check"]).stdout
    assert "at most 100 samples a second of each stream of everything" in " ".join(reported.split())


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ("{ lab = 20 }", r"stream_hz of eth0: 'lab' is not exported as such; there is rosie, rosie.imu"),
        ("25", r"stream_hz of eth0: 25 for rosie is none of 1, 2, 5, 10, 20, 50, 100, 200, 500 a second"),
        ("true", r"stream_hz: Expected `float \| object`, got `bool`"),
        ('{ "rosie.imu" = 20 }', r"rosie.imu is exported with all of 'rosie' as well, which lets more pass"),
        ('{ rosie = 50, "rosie.imu" = 20 }', r"rosie.imu is exported with all of 'rosie' as well"),
    ],
)
def test_a_limit_that_would_not_hold_is_refused(file: Path, limit: str, said: str) -> None:
    change(file, 'export = ["rosie"]', 'export = ["rosie", "rosie.imu"]')
    change(file, LIMIT, f"stream_hz = {limit} #")
    with pytest.raises(ConfigurationError, match=said):
        read_gateway_file(file)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ('system = "lab"', "", r"system: missing; write system = "),
        ('interface = "eth1"', "", r"interface: missing; write interface = "),
        (
            'interface = "eth1"',
            'interface = "eth0"',
            r"network.lab.interface: eth0 is the interface of network 'robot'",
        ),
        ('policy = "policy.toml"', 'polcy = "policy.toml"', r"polcy: unknown key; there is system, name, tls, policy"),
        ("export = []", 'exports = ["rosie"]', r"exports: unknown key; there is interface, listen, export"),
        ("export = []", 'export = ["rosie.*"]', r"network.lab.export: 'rosie.\*' is no group"),
        ("export = []", 'export = "rosie"', r"network.lab.export: Expected `array"),
        ('tls = "pki/issued/door"', "", r"tls: missing; name the folder with its certificate: trade pki issue"),
        ('tls = "pki/issued/door"', 'tls = "pki/issued/dor"', r"dor/ca.pem: cannot be read"),
        ('policy = "policy.toml"', 'policy = "none.toml"', r"none.toml: the policy cannot be read"),
        ('policy = "policy.toml"', "", r"listening beyond loopback needs a policy"),
        ('"tls/10.0.0.7:7450"', '"tcp/10.0.0.7:7450"', r"must be tls/10.0.0.7:7450"),
        ('"tls/10.0.0.7:7450"', '"tls/10.0.0.8:7450"', r"not for 10.0.0.8"),
        (
            '"tls/10.0.0.7:7450"',
            '"tls/127.0.5.1:7450"',
            r"listen: tls/127.0.5.1:7450: lo works only with 127.0.0.1",
        ),
        ('tls = "pki/issued/door"', 'credentials = "lab:secret"', r"credentials: is for laboratories"),
        ("[network.lab]", "[network", r"not valid TOML"),
    ],
)
def test_each_mistake_is_named(file: Path, before: str, after: str, said: str) -> None:
    change(file, before, after)
    with pytest.raises(ConfigurationError, match=said):
        read_gateway_file(file)


def test_certificates_of_containers_and_gateways_are_distinguished(file: Path) -> None:
    Papers(file.parent / "more").of("rosie")
    change(file, 'tls = "pki/issued/door"', 'tls = "more/issued/rosie"')
    said = r"gateway.toml: tls: .* has the certificate of 'rosie', which the policy does not list in gateways \(door\)"
    with pytest.raises(ConfigurationError, match=rf"{said}.*trade pki issue NAME --for gateway --address 192.168.7.1"):
        read_gateway_file(file)


def test_a_laboratory_may_do_without_certificates_on_purpose(file: Path) -> None:
    text = file.read_text().replace('tls = "pki/issued/door"', 'credentials = "lab:secret"\ninsecure_lan = true')
    file.write_text(text.replace("tls/", "tcp/").replace('policy = "policy.toml"', ""))
    settings = read_gateway_file(file).settings
    assert settings.credentials == ("lab", "secret")
    assert settings.insecure_lan


def test_a_change_is_seen_in_the_file_the_policy_the_revoked_names_and_the_certificate(file: Path) -> None:
    seen = [digest(file)]
    for path in ("gateway.toml", "policy.toml", "revoked.toml", "pki/issued/door/cert.pem"):
        beside = file.parent / path
        beside.write_text(beside.read_text() + "\n")
        assert digest(file) not in seen
        seen.append(digest(file))
        assert digest(file) == seen[-1]
    file.write_text("not TOML [")
    assert digest(file) not in seen  # and no error


def test_changes_are_reported_by_name(file: Path) -> None:
    def named() -> FileDigests:
        return named_by(file, read_gateway_file(file))

    before = named()
    assert named().since(before) == ""
    (file.parent / "revoked.toml").write_text('revoked = ["planner"]')
    assert named().since(before) == "revoked.toml has changed, planner is revoked now"
    before = named()
    Authority(file.parent / "pki").issue("door", lasts=timedelta(days=3))
    until = Certificate.read(file.parent / "pki" / "issued" / "door").until
    assert named().since(before) == f"new certificate of door until {until:%Y-%m-%d %H:%M} UTC"
    before = named()
    change(file.parent / "policy.toml", 'planner = ["viewer"]', "planner = []")
    assert named().since(before) == "policy.toml has changed, other identities"


def test_check_starts_nothing(file: Path) -> None:
    reported = CliRunner().invoke(app, ["gateway", str(file), "--check"])
    assert reported.exit_code == 0
    assert "is right" in reported.stdout
    change(file, 'interface = "eth1"', 'interface = "eth0"')
    with pytest.raises(ConfigurationError):
        CliRunner().invoke(app, ["gateway", str(file), "--check"], catch_exceptions=False)


def has(monkeypatch: pytest.MonkeyPatch, **addresses: str) -> None:
    """This host has these interfaces alone, each with its addresses, separated by spaces."""
    known = {name: frozenset(each.split()) for name, each in addresses.items()}
    monkeypatch.setattr(_gateway_file, "addresses", lambda: {"lo": frozenset({"127.0.0.1"}), **known})


def checked(file: Path) -> str:
    reported = CliRunner().invoke(app, ["gateway", str(file), "--check"])
    return str(reported.exception) if reported.exception else reported.stderr


def test_interfaces_that_were_swapped_are_refused_before_anything_starts(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    has(monkeypatch, eth0="192.168.7.1", eth1="10.0.0.7")
    assert "is an address" not in checked(file)
    has(monkeypatch, eth0="10.0.0.7", eth1="192.168.7.1 192.168.8.1")
    said = checked(file)
    assert said.startswith(f"{file}: network.robot.listen: tls/192.168.7.1:7450 is an address of eth1 on this host")
    assert "interface is eth0" in said and "(10.0.0.7)" in said
    started = CliRunner().invoke(app, ["gateway", str(file)])  # no other way to start it
    assert str(started.exception) == said
    assert read_gateway_file(file)  # as `trade system` reads it for other hosts


def test_a_host_that_has_the_address_nowhere_or_twice_says_nothing(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    has(monkeypatch, eth0="172.16.0.1")
    assert "is an address" not in checked(file)
    has(monkeypatch, eth0="192.168.7.1", eth1="10.0.0.7", br0="192.168.7.1 10.0.0.7")
    assert "is an address" not in checked(file)


def test_loopback_belongs_to_the_first_network_and_a_wildcard_to_all_networks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    has(monkeypatch, eth0="192.168.7.1", eth1="10.0.0.7")
    file = tmp_path / "gateway.toml"

    def lab(first: str, second: str) -> Path:
        networks = (
            f'[network.a]\ninterface = "eth0"\nlisten = ["{first}"]\n[network.b]\ninterface = "eth1"\n'
            f'listen = ["{second}"]\n'
        )
        file.write_text(f'{ALONE}insecure_lan = true\ncredentials = "a:b"\n{networks}')
        return file

    assert "is an address" not in checked(lab("tcp/127.0.0.1:7450", "tcp/10.0.0.7:7450"))
    assert "is an address" not in checked(lab("tcp/0.0.0.0:7450", "tcp/[::]:7450"))
    assert "network.b.listen: tcp/127.0.0.1:7451 is an address of lo" in checked(
        lab("tcp/192.168.7.1:7450", "tcp/127.0.0.1:7451")
    )


def test_the_addresses_of_this_host_are_listed_by_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "127.0.0.1" in addresses()[loopback_interface()]

    def address(family: int, text: str) -> SimpleNamespace:
        return SimpleNamespace(family=family, address=text)

    listed = {
        "eth7": [
            address(AF_INET6, "fd00::2"),
            address(AF_INET6, "fe80::1%eth7"),
            address(AF_PACKET, "02:fc:00:00:00:01"),
        ],
        "eth7:1": [address(AF_INET, "192.0.2.7")],
        "ifb0": [address(AF_PACKET, "02:fc:00:00:00:02")],
    }
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: listed)
    assert addresses() == {"eth7": {"fd00::2", "fe80::1", "192.0.2.7"}}


def test_a_host_that_forwards_between_the_networks_is_reported(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sysctls = tmp_path / "net"
    for version, name, value in (("ipv4", "eth0", 1), ("ipv4", "eth1", 0), ("ipv6", "eth1", 2)):
        (sysctls / version / "conf" / name).mkdir(parents=True)
        (sysctls / version / "conf" / name / "forwarding").write_text(f"{value}\n")
    on = forwarding(["eth0", "eth1", "eth2"], sysctls)
    assert on == ["net.ipv4.conf.eth0.forwarding", "net.ipv6.conf.eth1.forwarding"]
    has(monkeypatch)
    monkeypatch.setattr(_gateway, "forwarding", lambda names: forwarding(names, sysctls))
    assert "packets between its networks (net.ipv4.conf.eth0.forwarding, net" in checked(file)
    shutil.rmtree(sysctls)
    assert checked(file) == ""


@pytest.fixture
def sharing(file: Path) -> Path:
    """The example, with the share that it has as a comment."""
    head, _, share = file.read_text().partition("# [share.clinic]")
    lines = [line.removeprefix("# ") for line in f"[share.clinic]{share}".splitlines()]
    file.write_text(head + "\n".join(lines))
    (file.parent / "clinic").mkdir()
    (file.parent / "clinic" / "policy.toml").write_text(POLICY)
    issued = Papers(file.parent / "clinic" / "pki").of("guest", addresses=["172.16.0.7"])
    issued.rename(file.parent / "clinic" / "door")
    (file.parent / "clinic" / "revoked.toml").write_text("revoked = []")
    return file


def test_the_share_of_the_example_is_right_and_shown(sharing: Path) -> None:
    plan = read_gateway_file(sharing)
    guest = plan.shares["clinic"]
    assert (guest.system, guest.identity, guest.bridge) == ("clinic", "guest", ())
    assert guest.listen == ("tls/172.16.0.7:7450",)
    assert (plan.file.share["clinic"].export, plan.file.share["clinic"].import_) == (["rosie.head"], ["clinic.map"])
    reported = CliRunner().invoke(app, ["gateway", str(sharing), "--check"]).stdout
    assert "system clinic, as guest: it sees rosie.head of lab" in reported
    assert "lab sees clinic.map of clinic" in reported


def test_what_is_not_listed_is_not_shared(sharing: Path) -> None:
    change(sharing, 'export = ["rosie.head"]', "")
    change(sharing, 'import = ["clinic.map"]', "")
    share = read_gateway_file(sharing).file.share["clinic"]
    assert (share.export, share.import_) == ([], [])


def test_a_gateway_that_only_shares_joins_no_networks(sharing: Path) -> None:
    text = sharing.read_text()
    sharing.write_text(text[: text.index("[network.lab]")] + text[text.index("[share.clinic]") :])
    with pytest.raises(ConfigurationError, match=r"network.robot.export: there is no other network"):
        read_gateway_file(sharing)
    change(sharing, 'export = ["rosie"] ', "")
    settings = read_gateway_file(sharing).settings
    assert (settings.bridge, settings.exports, settings.listen) == ((), None, ("tls/192.168.7.1:7450",))


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ('system = "clinic"', "", r"share.clinic.system: missing"),
        ('system = "clinic"', 'system = "lab"', r"share.clinic.system: 'lab' is this system"),
        ('tls = "clinic/door"', "", r"share.clinic.tls: missing; .* by the authority of clinic"),
        ('tls = "clinic/door"', 'tls = "clinic/dor"', r"dor/ca.pem: cannot be read"),
        ('policy = "clinic/policy.toml"', "", r"share.clinic.policy: missing; name the policy of clinic"),
        ('policy = "clinic/policy.toml"', 'policy = "clinic/none.toml"', r"none.toml: the policy cannot be read"),
        ('export = ["rosie.head"]', 'export = ["rosie.*"]', r"share.clinic.export: 'rosie.\*' is no group"),
        ('import = ["clinic.map"]', 'import = ["a b"]', r"share.clinic.import: 'a b' is no group"),
        (
            'import = ["clinic.map"]',
            "imports = []",
            r"share.clinic.imports: unknown key; there is .*export, import,",
        ),
        ('"tls/172.16.0.7:7450"', '"tls/172.16.0.8:7450"', r"not for 172.16.0.8"),
        ('tls = "clinic/door"', 'credentials = "a:b"', r"share.clinic.credentials: is for laboratories"),
    ],
)
def test_each_mistake_in_a_share_is_named(sharing: Path, before: str, after: str, said: str) -> None:
    change(sharing, before, after)
    with pytest.raises(ConfigurationError, match=said):
        read_gateway_file(sharing)


def test_a_change_of_what_a_share_names_is_seen(sharing: Path) -> None:
    seen = [digest(sharing)]
    for path in ("clinic/policy.toml", "clinic/revoked.toml", "clinic/door/cert.pem"):
        beside = sharing.parent / path
        beside.write_text(beside.read_text() + "\n")
        assert digest(sharing) not in seen
        seen.append(digest(sharing))


def test_the_record_of_a_gateway_lies_beside_its_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_AUDIT", "/somewhere/else")
    monkeypatch.setenv("TRADE_AUDIT_KEEP_DAYS", "7")
    assert read_gateway_file(file).settings.audit is None
    change(file, 'system = "lab"', 'system = "lab"\naudit = "audit"')
    settings = read_gateway_file(file).settings
    assert (settings.audit, settings.audit_keep_days) == (file.parent / "audit", 7)
