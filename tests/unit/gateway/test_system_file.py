"""System files: what is right gives an order, what is wrong is named with its line before anything starts."""

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.support.certificates import Papers
from tests.support.simulated_robots import HEAD as SERVO_HEAD
from trade.errors import ConfigurationError
from trade_gateway.cli import app
from trade_gateway.config._toml_file import line_of
from trade_gateway.supervisor._system_file import read_system_file

pytestmark = pytest.mark.virtual_time

EXAMPLES = Path(__file__).parents[3] / "examples"
HEAD = '[system]\nname = "home"\n\n'
LAMPS = '[container.lamps]\nproviders = [{ class = "lamp:Lamp", groups = ["hall"] }]\n'
PAGE = "[container.page]\n"
KEPT = '[system]\nname = "home"\nsupervisor = "keeper"\n\n'
PROGRAM = f"{KEPT}[container.a]\n"
HEALTH = 'health = { command = ["ls"] }\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("rosie.toml", "head.toml", "care.toml", "system.toml"):
        shutil.copy(EXAMPLES / name, tmp_path)
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "system.toml"
    path.write_text(text)
    return path


def test_the_example_gives_each_container_its_words_in_order(folder: Path) -> None:
    plan = read_system_file(folder / "system.toml")
    assert plan.settings.system == "home"
    assert [part.name for part in plan.parts][-1] == "care"
    words = {part.name: " ".join(part.words) for part in plan.parts}
    assert words == {
        "rosie": f"--system home up {folder}/head.toml --name rosie --sim",
        "lamps": "--system home container --name lamps --allow lamp:Lamp",
        "attic": "--system home container --name attic --allow lamp:Lamp",
        "care": f"--system home rules run {folder}/care.toml --name care",
    }


def test_order_follows_after_and_not_the_file(folder: Path) -> None:
    chain = "".join(f'[container.{n}]\nproviders = []\nafter = ["{m}"]\n' for n, m in (("a", "b"), ("b", "c")))
    plan = read_system_file(write(folder, f"{HEAD}{chain}[container.c]\nproviders = []\n"))
    assert [part.name for part in plan.parts] == ["c", "b", "a"]


def test_files_of_another_host_are_as_that_host_sees_them(folder: Path) -> None:
    text = f'{HEAD}[container.arm]\nhost = "pi@arm.example"\nrobot = "arm.toml"\ntls = "/etc/trade/arm"\n'
    [part] = read_system_file(write(folder, text)).parts
    assert part.files == ["arm.toml", "/etc/trade/arm"]
    assert part.environment == {"TRADE_TLS": "/etc/trade/arm"}


def test_certificate_policy_and_endpoints_of_the_system_are_those_of_its_containers_here(folder: Path) -> None:
    Papers(folder / "pki").of("ops")
    (folder / "policy.toml").write_text('[roles.all]\ncall = ["*"]\n[identities]\nops = ["all"]\n')
    head = f'{HEAD.strip()}\ntls = "pki/issued/ops"\npolicy = "policy.toml"\nconnect = ["tls/127.0.0.1:7450"]\n\n'
    plan = read_system_file(write(folder, f'{head}{LAMPS}[container.far]\nhost = "far"\nproviders = []\n'))
    here, far = plan.parts
    assert plan.settings.identity == "ops"
    assert here.environment["TRADE_TLS"] == str(folder / "pki/issued/ops")
    assert here.environment["TRADE_POLICY"] == str(folder / "policy.toml")
    assert far.environment == {}  # its certificate is its own, and lies there
    assert all(part.words[2:4] == ["--connect", "tls/127.0.0.1:7450"] for part in plan.parts)


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("", 1, "system: missing"),
        (HEAD, 1, "container: missing"),
        (f"{HEAD}[robot.rosie]\n", 4, "unknown; there is"),
        ('[system]\nname = "home"\nfoo = 1\n', 3, "unknown key 'foo'; there is name, tls"),
        (f'{HEAD}{LAMPS}hots = "far"\n', 6, "unknown key 'hots'; there is host"),
        (f"{HEAD}{LAMPS.replace('class', 'klass')}", 5, "unknown key 'klass'; there is class, groups, args"),
        (f'{HEAD}[container.a]\nproviders = [\n  {{ groups = ["x"] }},\n]\n', 5, "class is missing"),
        (f"{HEAD}{LAMPS}after = 3\n", 6, "Expected `array`"),
        (f'{HEAD}{LAMPS}after = ["rosie"]\n', 6, "no container 'rosie'; there is lamps"),
        (f"{HEAD}[container.a]\n", 4, "takes one of robot, gateway, providers, rules, http, ros, record"),
        (f'{HEAD}{LAMPS}rules = "care.toml"\n', 6, "there is providers and rules"),
        (f"{HEAD}{LAMPS}sim = true\n", 6, "goes with robot"),
        (f'{HEAD}{LAMPS}without = ["legs"]\n', 6, "goes with robot"),
        (f'{HEAD}[container.a]\nrobot = "rosie.toml"\nallow = ["x:Y"]\n', 6, "goes with providers"),
        (f"{HEAD}{PAGE}http = {{}}\n", 5, "no client could log in; name tokens"),
        (f'{HEAD}{PAGE}http = {{ tokens = "t.toml" }}\n', 5, "trade http token NAME --tokens "),
        (f'{HEAD}{PAGE}http = {{ tls = "pki", twin = "rosie.toml" }}\n', 5, "are for agents; add mcp = true"),
        (f'{HEAD}{PAGE}http = {{ tls = "pki", mcp = true, twin = "missing.toml" }}\n', 4, "missing.toml"),
        (
            f"{HEAD}{PAGE}http = {{ port = 80 }}\n",
            5,
            "unknown key 'port'; there is listen, tokens, tls, origins, hosts",
        ),
        (f'{HEAD}{LAMPS}command = "/opt/trade"\n', 6, "goes with another host"),
        (f'{HEAD}[container.a]\nrobot = "missing.toml"\n', 5, "missing.toml: there is no such file"),
        (f'{HEAD}[container.a]\nrules = "rosie.toml"\n', 5, "rosie.toml"),
        (f'{HEAD}[container.a]\ngateway = "missing.toml"\n', 5, "there is no such file"),
        (f'{HEAD}[container.a]\ngateway = "x.toml"\ntls = "pki"\n', 6, "is set in the gateway file"),
        (f'{HEAD}[container."a/b"]\nproviders = []\n', 4, "is no name for a container"),
        (f'{HEAD}{LAMPS}tls = "nowhere"\n', 4, "nowhere"),
        (f'{HEAD}{LAMPS}policy = "missing.toml"\n', 4, "missing.toml"),
        (f'{HEAD}{LAMPS}connect = ["tcp/robot.example:7450"]\n', 4, "beyond loopback requires certificates"),
        (f'{HEAD}[container.a]\nprogram = ["ls"]\n', 5, 'write supervisor = "keeper" in [system]'),
        (f'{HEAD}{LAMPS}announces = "b"\n', 6, "goes with program; leave it out"),
        (f'{HEAD}[container.a]\nrecord = {{ file = "x" }}\n', 5, "unknown key 'file'; there is folder, groups"),
        (f'{HEAD}[container.a]\nros = "rosie.toml"\n', 5, "rosie.toml"),
        (f'{KEPT}{LAMPS}after = ["far"]\n[container.far]\nhost = "far"\nrules = "r"\n', 7, "cannot wait for far"),
        (f"{KEPT}[container.keeper]\nproviders = []\n", 3, "it has the name of a container"),
        (f'{KEPT}[container.far]\nhost = "far"\nrules = "r"\n', 3, "no container of this host"),
        (f'{KEPT}[container.far]\nhost = "far"\nprogram = ["ls"]\n', 6, "a program runs on the host of its"),
        (f"{PROGRAM}program = []\n", 6, "length >= 1"),
        (f'{PROGRAM}program = ["./missing"]\n', 6, "missing that this user may run"),
        (f'{PROGRAM}program = ["no-such-program"]\n', 6, "there is no no-such-program in PATH"),
        (f'{PROGRAM}program = ["./head.toml"]\n', 6, "head.toml that this user may run"),
        (f'{PROGRAM}program = ["ls"]\nfolder = "away"\n', 7, "there is no folder"),
        (f'{PROGRAM}program = ["ls"]\nenv = {{ "A B" = "c" }}\n', 7, "'A B' is no name of a variable"),
        (f'{PROGRAM}program = ["ls"]\nenv = {{ A = 1 }}\n', 7, "Expected `str`"),
        (f'{PROGRAM}program = ["ls"]\nannounces = "a/b"\n', 7, "is no name for a container"),
        (f'{PROGRAM}program = ["ls"]\ngrace_s = 60\n', 7, "<= 15"),
        (f'{PROGRAM}program = ["ls"]\nlog_mb = 0\n', 7, ">= 0.1"),
        (f'{PROGRAM}program = ["ls"]\n{HEALTH}announces = "b"\n', 7, "leave one out"),
        (f'{PROGRAM}program = ["ls"]\n{HEALTH.replace("ls", "no-such")}', 7, "there is no no-such in PATH"),
        (f'{PROGRAM}program = ["ls"]\n{HEALTH.replace("}", ", within_s = 9 }")}', 7, "within_s is longer"),
        (f'{PROGRAM}program = ["ls"]\nlease_from = "base"\n', 7, "goes with providers"),
        ('[system]\nname = "ho me"\n[container.a]\nproviders = []\n', 1, "is no name for a system"),
    ],
)
def test_each_mistake_is_named_with_its_line(folder: Path, text: str, line: int, said: str) -> None:
    path = write(folder, text)
    with pytest.raises(ConfigurationError) as wrong:
        read_system_file(path)
    assert str(wrong.value).startswith(f"{path}:{line}: ")
    assert str(wrong.value).count(f"{path}:") == 1, "it is said once where"
    assert said in str(wrong.value)


def test_a_ring_is_named_whole(folder: Path) -> None:
    ring = "".join(f'[container.{n}]\nproviders = []\nafter = ["{m}"]\n' for n, m in ("ab", "bc", "ca"))
    with pytest.raises(ConfigurationError, match=r":\d+: container\.\w\.after: is a ring: (a after b after c|b|c)"):
        read_system_file(write(folder, HEAD + ring))


@pytest.mark.parametrize(
    ("text", "said"),
    [(f"{HEAD}{LAMPS}{LAMPS}", "at line 6"), ("[system\n", "at line 1"), (None, "there is no such file")],
)
def test_a_name_twice_and_what_is_no_toml_are_named_with_their_line(folder: Path, text: str | None, said: str) -> None:
    path = folder / "none.toml" if text is None else write(folder, text)
    with pytest.raises(ConfigurationError, match=said):
        read_system_file(path)


def test_a_gateway_must_be_of_this_system_and_name(folder: Path) -> None:
    Papers(folder).of("door", purpose="gateway", addresses=["127.0.0.1"])
    shared = '[share.clinic]\nsystem = "clinic"\ncredentials = "a:b"\n'
    (folder / "gateway.toml").write_text(
        f'system = "lab"\nname = "door"\ninsecure_lan = true\ncredentials = "a:b"\n{shared}'
    )
    path = write(folder, f'{HEAD}[container.door]\ngateway = "gateway.toml"\n')
    with pytest.raises(ConfigurationError, match=r":5: container\.door\.gateway: .*system = 'lab'; here it is 'home'"):
        read_system_file(path)
    path.write_text(path.read_text().replace("home", "lab"))
    [part] = read_system_file(path).parts
    assert list(part.words) == ["--system", "lab", "gateway", str(folder / "gateway.toml")]
    path.write_text(path.read_text().replace("container.door", "container.gate"))
    with pytest.raises(ConfigurationError, match="name = 'door'; here it is 'gate'"):
        read_system_file(path)


def test_lines_are_found_in_quoted_and_spaced_tables() -> None:
    text = '[system]\n [ container . "a.b" ] # here\n"host" = "x"\n[container.c]\nhost = "y"\n'
    assert line_of(text, ("container", "a.b"), "host") == 3
    assert line_of(text, ("container", "c"), "host") == 5
    assert line_of(text, ("container", "c"), "rules") == 4
    assert line_of(text, ("container", "d"), "host") == 1


def test_a_file_is_checked_on_the_command_line_and_contradictions_are_refused(folder: Path) -> None:
    said = CliRunner().invoke(app, ["system", "up", str(folder / "system.toml"), "--check"])
    assert said.exit_code == 0
    assert said.stdout.splitlines()[-1] == "  care: rules"
    refused = CliRunner().invoke(app, ["--system", "lab", "system", "status", str(folder / "system.toml")])
    assert "leave out --system" in str(refused.exception)


def test_records_lie_where_the_system_says_or_the_container(folder: Path) -> None:
    head = f'{HEAD.strip()}\naudit = "audit"\n\n'
    far = '[container.far]\nhost = "far"\nproviders = []\n'
    text = f'{head}{LAMPS}[container.more]\nproviders = []\naudit = "/var/more"\n{far}'
    plan = read_system_file(write(folder, text))
    places = {part.name: part.environment.get("TRADE_AUDIT") for part in plan.parts}
    assert places == {"lamps": str(folder / "audit"), "more": "/var/more", "far": None}
    assert plan.settings.audit is None


def test_an_http_gateway_starts_with_the_options_of_its_table(folder: Path) -> None:
    (folder / "t.toml").touch()
    said = 'http = { tokens = "t.toml", listen = "127.0.0.1:7081", origins = ["http://a", "http://b"] }\n'
    [part] = read_system_file(write(folder, f"{HEAD}{PAGE}{said}")).parts
    named = ["--listen", "127.0.0.1:7081", "--origin", "http://a", "--origin", "http://b"]
    assert list(part.words)[2:] == ["http", "--name", "page", *named, "--tokens", str(folder / "t.toml")]
    said = 'http = { tokens = "t.toml", mcp = true, ask_first = ["a", "b"], twin = "rosie.toml" }\n'
    [part] = read_system_file(write(folder, f"{HEAD}{PAGE}{said}")).parts
    words = " ".join(part.words)
    assert words.endswith(f"--ask-first a --ask-first b --tokens {folder}/t.toml --twin {folder}/rosie.toml --mcp")


def two_robots(folder: Path, second: str, more: str = "") -> Path:
    """A system with two robots, whose files name ports of this host."""
    for name, robot, port in (("one", "rosie", "/dev/null"), ("other", "ada", second)):
        text = SERVO_HEAD.replace('"rosie"', f'"{robot}"').replace("/dev/ttyNOWHERE", port)
        (folder / f"{name}.toml").write_text(text)
    tables = f'[container.one]\nrobot = "one.toml"\n[container.other]\nrobot = "other.toml"\n{more}'
    return write(folder, f"{HEAD}{tables}")


def test_an_adapter_that_two_robots_of_a_host_name_is_refused_with_both_files(folder: Path) -> None:
    link = folder / "by-id"
    link.symlink_to("/dev/null")
    with pytest.raises(ConfigurationError, match=r"other.toml: bus.neck.port: .*one.toml: bus.neck.port already"):
        read_system_file(two_robots(folder, str(link)))
    assert len(read_system_file(two_robots(folder, "/dev/zero")).parts) == 2
    assert len(read_system_file(two_robots(folder, str(link), "sim = true\n")).parts) == 2
