"""The files that pages show, read by what reads them."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from msgspec import toml

from tests.docs.blocks import DOCS, ROOT, Section, of, said, sections
from tests.support.certificates import Papers
from tests.support.simulated_robots import HEAD
from trade._security.policy_file import read_policy
from trade.rules import read_rules
from trade_drivers import Robot, attach, load, parse
from trade_gateway.config._gateway_file import Plan, read_gateway_file
from trade_gateway.language import read_lexicon
from trade_gateway.supervisor._system_file import read_system_file
from trade_hil_sim import SimProcess

ROSIE = '[robot]\nname = "rosie"\n'
POLICY = '[roles.viewer]\nread = ["*"]\n[identities]\nann = ["viewer"]\n'
JOINT = "min_rad = -0.8\nmax_rad = 0.8\nmax_speed_rad_s = 2.0\nmax_accel_rad_s2 = 10.0\n"


def test_every_file_of_the_pages_is_read() -> None:
    pages = [page for page in DOCS.rglob("*.md") if page.parent.name != "tutorials"]  # these are typed as they stand
    assert sections(iter(pages), "toml") == said(globals())


@pytest.fixture
def text(request: pytest.FixtureRequest) -> str:
    """What the section that the test names shows."""
    section: Section = request.function.section
    [block] = section.blocks("toml")
    return block.text


def save(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def robot(text: str) -> Robot:
    return parse(text, "the page")


def gateway(folder: Path, text: str) -> Plan:
    """A gateway file, beside what files of the guide name."""
    for name in ("policy.toml", "clinic/policy.toml"):
        save(folder, name, POLICY)
    addresses = ["192.168.7.1", "10.0.0.7"]
    Papers(folder / "pki").of("door", purpose="gateway", addresses=addresses)
    Papers(folder / "clinic-pki").of("guest", addresses=["172.16.0.7"])
    (folder / "clinic" / "door").symlink_to(folder / "clinic-pki" / "issued" / "guest")
    save(folder, "rosie.toml", (ROOT / "examples" / "head.toml").read_text(encoding="utf-8"))
    save(folder, "mind.py", "class Planner: ...\n")
    save(folder, "http-tokens.toml", "")
    return read_gateway_file(save(folder, "gateway.toml", text))


@of("guide.md", "Let a system configure itself")
def test_rules(tmp_path: Path, text: str) -> None:
    [rule] = read_rules(save(tmp_path, "rules.toml", text)).values()
    assert [step.always for step in rule.do] == [False, False, True]


@of("guide.md", "Have one robot look at another")
def test_the_rule_is_that_of_the_example(text: str) -> None:
    assert text in (ROOT / "examples" / "witness.toml").read_text(encoding="utf-8")
    read_rules(ROOT / "examples" / "witness.toml")


@of("guide.md", "Ask in sentences")
def test_a_lexicon(tmp_path: Path, text: str) -> None:
    lexicon = read_lexicon(save(tmp_path, "mine.toml", text))
    for sentence in ("look 0.3 rad", "look 0.3 radians to the left"):
        assert lexicon.hear(sentence).gaps == {"number": "0.3"}
    assert lexicon.hear("start a vision provider on rover").gaps["kind"] == "mypkg.vision:Camera"


@of("guide.md", "Who may do what")
def test_a_policy(tmp_path: Path, text: str) -> None:
    policy = read_policy(save(tmp_path, "policy.toml", text))
    assert policy.decide("planner", "call", "rosie.neck").allowed
    assert policy.decide("rosie", "register", "rosie").allowed  # who brings her up has that identity
    assert not policy.decide("dash-1", "call", "rosie.neck").allowed


@of("guide.md", "A gateway")
def test_a_gateway(tmp_path: Path, text: str) -> None:
    settings = gateway(tmp_path, text).settings
    assert settings.exports == {"eth0": ("rosie",), "eth1": ()}
    example: dict[str, Any] = toml.decode((ROOT / "examples" / "gateway.toml").read_text(encoding="utf-8"))
    shown: dict[str, Any] = toml.decode(text)
    assert shown["network"]["robot"].pop("stream_hz") == 20.0
    assert shown == example


@of("guide.md", "A robot's computer that looks after itself")
def test_a_gateway_that_looks_after_containers(tmp_path: Path, text: str) -> None:
    assert [child.name for child in gateway(tmp_path, text).children] == ["rosie", "mind"]


@of("guide.md", "A whole system from one file")
def test_a_system_with_a_supervisor(tmp_path: Path, text: str) -> None:
    (tmp_path / "planner").touch(mode=0o755)
    (tmp_path / "ros.toml").write_text('[ros]\nversion = 1\n[[to_ros.lock]]\ngroup = "rosie"\n')
    shutil.copy(ROOT / "examples" / "rosie.toml", tmp_path)
    plan = read_system_file(save(tmp_path, "system.toml", text))
    assert [part.entry.kind for part in plan.parts] == ["gateway", "robot", "ros", "record", "program"]
    assert plan.supervised == {"rosie", "bridge", "recorder", "planner"}


@of("guide.md", "When a host is lost")
def test_two_gateways_side_by_side(tmp_path: Path, text: str) -> None:
    columns = [line.partition("#")[::2] for line in text.splitlines() if not line.startswith("#")]
    rover = gateway(tmp_path / "rover", "\n".join(left for left, _ in columns))
    base = gateway(tmp_path / "base", "\n".join(right for _, right in columns))
    assert (rover.settings.container, base.settings.container) == ("rover", "base")
    assert [child.terms.lease_from for child in rover.children] == ["base"]
    assert [child.terms.stands_in_for for child in base.children] == ["rover"]


@of("guide.md", "Sharing with another system")
def test_a_share(tmp_path: Path, text: str) -> None:
    [door] = Section("guide.md", "A gateway").blocks("toml")
    assert set(gateway(tmp_path, door.text + text).shares) == {"clinic"}


@pytest.mark.realtime
@of("drivers.md", "The robot file")
def test_a_robot_file(tmp_path: Path, text: str) -> None:
    """What its drivers have to say of it is said by them, on the simulated devices."""
    whole = load(save(tmp_path, "rosie.toml", text))
    with SimProcess(tmp_path / "rosie.toml") as sim, attach(whole, ports=sim.ports, announced=False) as rosie:
        assert rosie.group("head").joints() == ["rosie.neck.pan", "rosie.neck.tilt"]
        assert rosie.gripper("left.hand").limits().max_width_m == 0.085


@of("drivers.md", "Dynamixel")
def test_servos(text: str) -> None:
    assert robot(ROSIE + text).joints[0].name == "neck.pan"


@of("drivers.md", "Feetech")
def test_other_servos(text: str) -> None:
    assert robot(ROSIE + text).joints[0].name == "right.elbow"


@of("drivers.md", "CiA 402")
def test_drives(text: str) -> None:
    assert robot(ROSIE + text + JOINT).joints[0].name == "legs.left.hip"


@of("drivers.md", "Robotiq")
def test_a_gripper(text: str) -> None:
    assert robot(ROSIE + text).grippers[0].name == "left.hand"


@of("drivers.md", "Universal Robots")
def test_an_arm(text: str) -> None:
    assert robot(ROSIE + text).arms[0].poses.keys() == {"home"}


@of("drivers.md", "Cameras and sensors")
def test_senses(text: str) -> None:
    found = robot(ROSIE + text)
    assert [one.name for one in (*found.cameras, *found.sensors)] == ["eye", "oven.temperature"]


@of("drivers.md", "Writing a driver")
def test_an_entry_point(text: str) -> None:
    assert toml.decode(text) == {"project": {"entry-points": {"trade.drivers": {"acme": "acme_trade:AcmeDriver"}}}}


@of("drivers.md", "In an afternoon: a sensor as a plug-in")
def test_the_entry_points_are_those_of_the_example(text: str) -> None:
    assert text in (ROOT / "examples" / "plugin" / "pyproject.toml").read_text(encoding="utf-8")


@of("access-control.md", "The policy")
def test_a_policy_with_revoked_names(tmp_path: Path, text: str) -> None:
    save(tmp_path, "revoked.toml", 'revoked = ["old-arm"]')
    assert read_policy(save(tmp_path, "policy.toml", text)).decide("anna", "administer", "rosie").allowed


@of("agents.md", "What keeps an agent in bounds")
def test_approvals(tmp_path: Path, text: str) -> None:
    assert read_policy(save(tmp_path, "policy.toml", POLICY + text)).approval == {"agent*": ("rosie.legs",)}


@of("commissioning.md", "Is it still the same device?")
def test_a_joint_that_says_which_device_it_means(text: str) -> None:
    rest = f'{ROSIE}[bus.neck]\ndriver = "dynamixel"\nport = "/dev/ttyUSB0"\n'
    assert robot(f'{rest}{text}bus = "neck"\nid = 1\n{JOINT}').joints[0].firmware == "45"


@of("commissioning.md", 'From "works" to "starts at boot"')
def test_a_gateway_file_that_keeps_a_robot_up(tmp_path: Path, text: str) -> None:
    assert [child.name for child in gateway(tmp_path, text).children] == ["rosie"]


@of("deployment.md", "On a robot's computer")
def test_the_same_where_deployment_begins(tmp_path: Path, text: str) -> None:
    assert [child.name for child in gateway(tmp_path, text).children] == ["rosie"]


@of("drill.md", "Drills: does the robot stop when a part fails?")
def test_limits_of_a_drill(text: str) -> None:
    assert robot(HEAD + text).drill


@of("http.md", "Beyond this host")
def test_rights_of_an_http_gateway(tmp_path: Path, text: str) -> None:
    policy = read_policy(save(tmp_path, "policy.toml", f'[roles.operator]\ncall = ["rosie"]\n{text}'))
    assert policy.decide("page", "call", "rosie.head") == policy.decide("anna", "call", "rosie.head")


@of("http.md", "HTTP and WebSocket")
def test_an_http_gateway(tmp_path: Path, text: str) -> None:
    save(tmp_path, "http-tokens.toml", "")
    plan = read_system_file(save(tmp_path, "system.toml", f'[system]\nname = "home"\n{text}'))
    assert [part.name for part in plan.parts] == ["page"]
    assert gateway(tmp_path / "gateway", f'system = "home"\n{text}').children[0].name == "page"
