"""What `trade install` writes: only what is its own, and a unit that may do no more than its gateway needs."""

import os
import pwd
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from msgspec import structs
from typer.testing import CliRunner, Result

from tests.support.simulated_robots import HEAD
from trade.errors import ConfigurationError
from trade_drivers import load
from trade_gateway._usage import UsageError
from trade_gateway.cli import app
from trade_gateway.cli.operation import _install
from trade_gateway.cli.operation._file_closure import named_files
from trade_gateway.cli.operation._install import _closed_to
from trade_gateway.cli.operation._systemd_unit import UDEV_RULES, HostResources, needs_of, unit_text

pytestmark = pytest.mark.virtual_time

EXAMPLES = Path(__file__).parents[3] / "examples"
FILE = """
system = "lab"
credentials = "lab:secret"
insecure_lan = true

[network.robot]
interface = "eth0"
listen = ["tcp/192.168.7.1:7450"]

[network.lab]
interface = "eth1"
listen = ["tcp/10.0.0.7:7450"]
"""
MOST_EXPOSED = 2.0


@pytest.fixture
def _systemd() -> None:
    """Skips where there is no systemd, and fails there in CI."""
    if shutil.which("systemd-analyze") is None:
        reason = "there is no systemd-analyze"
        pytest.fail(reason) if os.environ.get("CI") == "true" else pytest.skip(reason)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "etc" / "gateway.toml"
    made.parent.mkdir()
    made.write_text(FILE)
    return made


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "root"


def install(file: Path, root: Path, *more: str) -> Result:
    return CliRunner().invoke(app, ["install", str(file), "--root", str(root), *more], catch_exceptions=False)


def unit(root: Path, name: str = "trade-gateway") -> Path:
    return root / "etc" / "systemd" / "system" / f"{name}.service"


def rules(root: Path) -> Path:
    return root / "etc" / "udev" / "rules.d" / "60-trade.rules"


def a_unit(needs: HostResources = HostResources(), gateway: str = "/etc/trade/gateway.toml", **parts: object) -> str:  # noqa: B008 - frozen
    usual = {"user": "trade", "containers": 0, "program": ["/opt/trade/bin/trade"], "folders": [], "records": []}
    return unit_text(Path(gateway), needs=needs, **{**usual, **parts})  # type: ignore[arg-type]


def said_of(text: str, key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", text, re.MULTILINE)


def test_it_writes_both_files_and_says_what_to_run_next(file: Path, root: Path) -> None:
    reported = install(file, root).stdout
    [command] = said_of(unit(root).read_text(), "ExecStart")
    assert command == f"{sys.executable} -m trade_gateway gateway {file}"
    assert UDEV_RULES in rules(root).read_text()
    assert (unit(root).stat().st_mode & 0o777, rules(root).stat().st_mode & 0o777) == (0o644, 0o644)
    for words in ("systemctl daemon-reload", "systemctl enable trade-gateway", "udevadm control --reload"):
        assert words in reported


def test_again_it_writes_only_what_has_become_different(file: Path, root: Path) -> None:
    install(file, root)
    before = (unit(root).stat().st_ino, rules(root).stat().st_ino)
    reported = " ".join(install(file, root).stdout.split())
    assert (unit(root).stat().st_ino, rules(root).stat().st_ino) == before
    assert "wrote" not in reported
    install(file, root, "--user", "robot")
    assert said_of(unit(root).read_text(), "User") == ["robot"]
    assert rules(root).stat().st_ino == before[1]


@pytest.mark.parametrize("kind", ["changed since", "not written by"])
def test_a_file_that_another_program_wrote_or_changed_is_overwritten_only_by_force(
    file: Path, root: Path, kind: str
) -> None:
    install(file, root)
    theirs = rules(root).read_text() + "# mine\n" if kind == "changed since" else "# mine\n"
    rules(root).write_text(theirs)
    unit(root).unlink()
    with pytest.raises(ConfigurationError, match=rf"60-trade.rules: was {kind}.*--force\. Nothing was written"):
        install(file, root)
    assert (rules(root).read_text(), unit(root).exists()) == (theirs, False)
    install(file, root, "--force")
    assert UDEV_RULES in rules(root).read_text()


def test_what_the_services_user_may_not_read_is_warned_of_with_the_remedy(tmp_path: Path) -> None:
    own, papers = tmp_path / "etc", tmp_path / "etc" / "gate"
    papers.mkdir(parents=True)
    user = pwd.getpwnam("nobody")  # plain: nobody
    file, key, elsewhere = own / "gateway.toml", papers / "key.pem", tmp_path / "elsewhere"
    for path, mode in ((file, 0o644), (key, 0o600), (elsewhere, 0o600), (own, 0o755), (papers, 0o700)):
        path.touch()
        path.chmod(mode)
    reported = list(_closed_to("nobody", [file, key, elsewhere]))  # plain: nobody
    assert [words.split(", so")[0] for words in reported] == [
        f"user nobody cannot enter {papers}",  # plain: nobody
        f"user nobody cannot read {key}",  # plain: nobody
    ]
    assert f"sudo chgrp {user.pw_gid} {papers} && sudo chmod 0750 {papers}" in reported[0]
    papers.chmod(0o755)
    key.chmod(0o644)
    assert not list(_closed_to("nobody", [file, key]))  # plain: nobody
    assert not list(_closed_to("no-such-user", [file, key]))


def test_what_the_service_may_not_find_is_warned_of(file: Path, root: Path, tmp_path: Path) -> None:
    (file.parent / "rosie.toml").write_text(HEAD.replace("/dev/ttyNOWHERE", "/tmp/lines/neck"))
    file.write_text('system = "lab"\n[container.rosie]\nrobot = "rosie.toml"\n')
    reported = " ".join(install(file, tmp_path / "root").stdout.split())
    assert "warning port /tmp/lines/neck lies in /tmp, which the service does not see" in reported
    assert f"warning file {file} lies in /" in reported


def test_files_in_permanent_places_cause_no_warning(root: Path, tmp_path: Path) -> None:
    there = root / "etc" / "trade" / "gateway.toml"
    there.parent.mkdir(parents=True)
    there.write_text(FILE)
    assert "warning file" not in install(there, root).stdout


def test_a_file_named_as_the_other_computer_sees_it_is_looked_for_in_its_folder(root: Path) -> None:
    there = root / "etc" / "trade" / "no-such-gateway.toml"
    there.parent.mkdir(parents=True)
    there.write_text(FILE)
    with pytest.raises(UsageError, match=f"did you mean {there}"):
        install(Path("/etc/trade/no-such-gateway.toml"), root)


def test_a_wrong_gateway_file_writes_nothing(file: Path, root: Path) -> None:
    file.write_text(FILE.replace('"eth1"', '"eth0"'))
    with pytest.raises(ConfigurationError, match="eth0 is the interface of network"):
        install(file, root)
    assert not root.exists()


def test_it_prints_what_it_would_write(file: Path, root: Path) -> None:
    reported = install(file, root, "--print").stdout
    assert not root.exists()
    install(file, root)
    assert reported == "".join(f"# {path}\n{path.read_text()}\n" for path in (unit(root), rules(root)))


def test_without_rights_it_says_how_to_get_them(file: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, text: bytes, mode: int) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(_install, "replace", refuse)
    monkeypatch.setattr(sys, "argv", ["trade", "install", "my gateway.toml"])
    with pytest.raises(ConfigurationError, match=r"rights of root: sudo .*python.* install 'my gateway.toml'"):
        install(file, root)


@pytest.mark.parametrize("words", [("--name", "a/b"), ("--user", "Robot One")], ids=" ".join)
def test_names_that_systemd_would_not_take_are_refused(file: Path, root: Path, words: tuple[str, str]) -> None:
    with pytest.raises(ConfigurationError, match="is no valid name"):
        install(file, root, *words)


def test_a_gateway_without_robots_has_no_devices_and_no_can() -> None:
    text = a_unit()
    assert said_of(text, "PrivateDevices") == ["yes"]
    assert said_of(text, "DeviceAllow") == said_of(text, "SupplementaryGroups") == []
    assert said_of(text, "RestrictAddressFamilies") == ["AF_UNIX AF_INET AF_INET6 AF_NETLINK"]


def test_it_may_use_what_its_robots_name_and_nothing_else() -> None:
    head = a_unit(needs_of([load(EXAMPLES / "head.toml")]))
    assert said_of(head, "DeviceAllow") == ["char-ttyUSB rw", "char-ttyACM rw"]
    assert said_of(head, "SupplementaryGroups") == ["dialout"]
    assert "AF_CAN" not in head
    legs = a_unit(needs_of([load(EXAMPLES / "legs.toml")]))
    assert said_of(legs, "PrivateDevices") == ["yes"]
    assert said_of(legs, "RestrictAddressFamilies") == ["AF_UNIX AF_INET AF_INET6 AF_NETLINK AF_CAN"]


def test_a_port_that_stays_where_it_is_is_allowed_by_its_name(tmp_path: Path) -> None:
    robot = tmp_path / "robot.toml"
    robot.write_text(re.sub(r'"/dev/serial/[^"]*"', '"/dev/ttyAMA0"', (EXAMPLES / "head.toml").read_text()))
    eye = tmp_path / "eye.toml"
    eye.write_text('[robot]\nname = "eye"\n[camera.front]\ndriver = "usbcam"\ndevice = "/dev/video0"\n')
    legs = tmp_path / "legs.toml"
    slow = (EXAMPLES / "legs.toml").read_text().replace('"socketcan"', '"slcan"').replace('"can0"', '"/dev/ttyACM3"')
    legs.write_text(slow)
    assert needs_of(map(load, (robot, eye))).devices == ("char-ttyUSB", "char-ttyACM", "/dev/ttyAMA0", "/dev/video0")
    assert needs_of([load(legs)]) == HostResources(serial=True, devices=("char-ttyUSB", "char-ttyACM"), real_time=True)


def test_the_unit_exposes_needed_paths_in_hidden_folders_read_only() -> None:
    named = ["/home/anna/trade", "/home/anna/trade/lib", "/opt/trade", "/home/anna/tradex", "/home/a $5"]
    text = a_unit(folders=map(Path, named))
    assert said_of(text, "ProtectHome") == ["tmpfs"]
    assert said_of(text, "BindReadOnlyPaths") == ['"/home/a $5"', "/home/anna/trade", "/home/anna/tradex"]
    assert said_of(a_unit(folders=[Path("/opt/trade")]), "ProtectHome") == ["yes"]


def test_a_robots_computer_that_its_gateway_looks_after(tmp_path: Path, root: Path) -> None:
    shutil.copy(EXAMPLES / "head.toml", tmp_path)
    shutil.copy(EXAMPLES / "legs.toml", tmp_path)
    file = tmp_path / "robot.toml"
    tables = [f'[container.{part}]\nrobot = "{part}.toml"\n' for part in ("head", "legs")]
    file.write_text("\n".join(['system = "lab"', 'audit = "/srv/record"', *tables]))
    assert "install --directory --owner trade --mode 0700 /srv/record" in " ".join(install(file, root).stdout.split())
    text = unit(root).read_text()
    assert said_of(text, "DeviceAllow") == ["char-ttyUSB rw", "char-ttyACM rw"]
    assert said_of(text, "RestrictAddressFamilies")[0].endswith(" AF_CAN")
    assert said_of(text, "ReadWritePaths") == ["/srv/record"]
    assert said_of(text, "TimeoutStopSec") == said_of(a_unit(containers=2), "TimeoutStopSec")


def test_for_another_computer_paths_are_as_that_one_sees_them(file: Path, root: Path, tmp_path: Path) -> None:
    image = tmp_path / "image"
    (image / "etc" / "trade").mkdir(parents=True)
    inside = image / "etc" / "trade" / "gateway.toml"
    inside.write_text(f'audit = "record"\n{FILE}')
    install(Path(f"{image}/etc/../etc/trade/gateway.toml"), image)
    text = unit(image).read_text()
    assert said_of(text, "ExecStart")[0].endswith(" gateway /etc/trade/gateway.toml")
    assert said_of(text, "ReadWritePaths") == ["/etc/trade/record"]
    assert str(image) not in text


def test_it_may_write_where_its_record_lies_and_its_state() -> None:
    places = [Path("/var/lib/trade/record"), Path("/srv/record"), Path("/home/anna/record")]
    text = a_unit(records=places)
    assert (said_of(text, "ReadWritePaths"), said_of(text, "BindPaths")) == (["/srv/record"], ["/home/anna/record"])
    assert said_of(text, "ProtectHome") == ["tmpfs"]


def test_only_a_unit_with_drivers_may_run_in_real_time() -> None:
    text = a_unit(needs_of([load(EXAMPLES / "rosie.toml")]))
    assert (said_of(text, "LimitRTPRIO"), said_of(text, "LimitMEMLOCK")) == (["10"], ["infinity"])
    assert said_of(text, "SystemCallFilter")[-2:] == ["~@privileged @resources", "sched_setscheduler"]
    assert said_of(text, "RestrictRealtime") == []
    alone = a_unit()
    assert (said_of(alone, "LimitRTPRIO"), said_of(alone, "RestrictRealtime")) == ([], ["yes"])
    assert said_of(alone, "SystemCallFilter")[-1] == "~@privileged @resources"


def test_only_the_unit_of_a_hub_may_precede_others() -> None:
    text = a_unit(HostResources(real_time=True, hub=True))
    assert said_of(text, "LimitNICE") == ["-10"]
    assert said_of(text, "SystemCallFilter")[-1] == "sched_setscheduler setpriority"
    assert said_of(text, "LimitRTPRIO") == ["10"]
    alone = a_unit(HostResources(hub=True))
    assert (said_of(alone, "LimitNICE"), said_of(alone, "RestrictRealtime")) == (["-10"], ["yes"])
    assert said_of(a_unit(), "LimitNICE") == []


@pytest.mark.parametrize("where", ["gateway", "inner"])
def test_a_hub_is_found_in_the_gateway_file_and_in_those_that_it_runs(tmp_path: Path, where: str) -> None:
    lines = {"gateway": "", "inner": "", where: "hub = true\n"}
    (tmp_path / "inner.toml").write_text(f'system = "lab"\n{lines["inner"]}')
    outer = tmp_path / "outer.toml"
    outer.write_text(f'system = "lab"\n{lines["gateway"]}[container.door]\ngateway = "inner.toml"\n')
    assert named_files(outer).hub
    (tmp_path / "inner.toml").write_text('system = "lab"\n')
    assert named_files(tmp_path / "inner.toml").hub is False


def test_it_waits_longer_for_a_gateway_that_looks_after_others() -> None:
    alone, several = (int(said_of(a_unit(containers=count), "TimeoutStopSec")[0]) for count in (0, 3))
    assert several == 4 * alone


@pytest.mark.realtime
@pytest.mark.usefixtures("_systemd")
@pytest.mark.parametrize("robots", [[], ["rosie.toml"]], ids=["a gateway", "a robot's computer"])
def test_systemd_takes_the_unit_and_finds_it_exposed_little(tmp_path: Path, robots: list[str]) -> None:
    made = tmp_path / "trade-gateway.service"
    needs = structs.replace(needs_of(load(EXAMPLES / robot) for robot in robots), hub=True)
    made.write_text(a_unit(needs, program=[sys.executable], folders=[Path("/home/anna/trade")]))
    verified = analyze("verify", "--man=no", str(made))
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = analyze("security", "--offline=yes", f"--threshold={MOST_EXPOSED * 10:.0f}", str(made))
    assert judged.returncode == 0, judged.stdout


@pytest.mark.realtime
@pytest.mark.usefixtures("_systemd")
def test_a_path_with_signs_that_mean_something_to_systemd_arrives_as_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "a %i b"
    folder.mkdir()
    program, made = folder / "trade", tmp_path / "trade-gateway.service"
    made.write_text(a_unit(program=[str(program)], gateway='/etc/a "b"\\ $HOME/gateway.toml'))
    assert said_of(made.read_text(), "ExecStart")[0].endswith(r'gateway "/etc/a \"b\"\\ $$HOME/gateway.toml"')
    assert "is not executable" in analyze("verify", "--man=no", str(made)).stderr
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    assert analyze("verify", "--man=no", str(made)).stderr == ""


def analyze(*words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(["systemd-analyze", *words], capture_output=True, text=True, timeout=60, check=False)


def test_udev_can_read_the_rules() -> None:
    word = r'[A-Z]+(\{\w+\})?(==|!=|=|\+=|:=)"[^"]*"'
    lines = [line for line in UDEV_RULES.splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(rf"{word}(, {word})*", line) for line in lines)
    labels, jumps = (re.findall(rf'{kind}="(\w+)"', UDEV_RULES) for kind in ("LABEL", "GOTO"))
    assert labels == jumps
    assert 'ATTR{latency_timer}="1"' in UDEV_RULES
