"""Containers started on other hosts, through a real sshd."""

import contextlib
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

import trade
from tests.support.waiting import wait_until
from tests.system.sshd import Sshd
from trade import where
from trade._remote import ssh
from trade.errors import CannotStart, ConfigurationError

Command = Callable[..., subprocess.CompletedProcess[str]]
HERE = (sys.executable, "-m", "trade_gateway")


@contextlib.contextmanager
def ended(name: str, pid: int) -> Iterator[None]:
    """End the container and wait for its process at the end of the block."""
    process = psutil.Process(pid)
    try:
        yield
        trade.find(where(name="terminate_container", container=name), wait_s=30)("the test is over")
        wait_until(lambda: not process.is_running() or process.status() == psutil.STATUS_ZOMBIE)
    finally:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()


def test_a_container_is_started_used_and_ended_on_another_host(sshd: Sshd) -> None:
    started = trade.system.start_container(
        "robot", "eyes", allow=["sight:*"], command=HERE, ssh_config=sshd.config, wait_s=30
    )
    with ended("eyes", started.pid):
        assert (started.name, started.host) == ("eyes", socket.gethostname())
        instantiate = trade.find(where(name="instantiate", container="eyes"))
        [see] = instantiate("sight:Eye", (), ["rosie.eyes"])
        assert see() == "a cat"


def test_another_container_starts_one_with_all_that_it_needs_and_code_is_brought_to_it(
    sshd: Sshd,
    start_container: Callable[[str], trade.Container],
    trade_command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A service has no file of ssh's settings: it takes those of its user."""
    (tmp_path / "bin").mkdir()
    ours = tmp_path / "bin" / "ssh"
    ours.write_text(f'#!/bin/sh\nexec {shutil.which("ssh")} -F {sshd.config} "$@"\n')
    ours.chmod(0o755)
    monkeypatch.setenv("PATH", f"{ours.parent}:{os.environ['PATH']}")
    (tmp_path / "brought_eye.py").write_text(
        "from trade import service\nclass Eye:\n    @service\n    def see(self) -> str:\n        return 'a dog'\n"
    )
    code = tmp_path / "code"
    code.mkdir()
    (tmp_path / "brought_eye.py").rename(code / "brought_eye.py")
    shown = trade_command("code", code)
    start_container("starter")
    start = trade.find(where(name="start_container", container="starter"), wait_s=30).with_(deadline_s=60)
    started = start(
        "robot",
        "eyes",
        allow=["brought_eye:Eye"],
        command=HERE,
        environment={"TRADE_CODE": shown.stdout.strip(), "TRADE_STATE_DIR": str(tmp_path / "state")},
    )
    with ended("eyes", started.pid):
        sent = trade_command("code", code, "--to", "eyes")
        assert sent.returncode == 0, sent.stderr
        [see] = trade.find(where(name="instantiate", container="eyes"))("brought_eye:Eye", (), ["rosie.eyes"])
        assert see() == "a dog"


def test_it_is_started_on_the_command_line_and_outlives_that(sshd: Sshd, trade_command: Command) -> None:
    command = Path(sys.executable).parent / "trade"
    ran = trade_command("start", "robot", "eyes", "--command", command, "--ssh-config", sshd.config, "--json")
    assert ran.returncode == 0, ran.stderr
    with ended("eyes", json.loads(ran.stdout)["pid"]):
        assert trade.find(where(name="clock", container="eyes"), wait_s=30)() > 0


def test_a_second_container_of_one_name_is_not_started(sshd: Sshd) -> None:
    started = trade.system.start_container("robot", "eyes", command=HERE, ssh_config=sshd.config, wait_s=30)
    with ended("eyes", started.pid):
        with pytest.raises(CannotStart, match="'eyes' is up already") as refused:
            trade.system.start_container("robot", "eyes", command=HERE, ssh_config=sshd.config)
        assert refused.value.reason == "it did not come up"


def stranger(sshd: Sshd, wait_s: float = 1.0) -> CannotStart:
    """The error of a start of a container that cannot join the system."""
    environment = {"TRADE_CREDENTIALS": "other:secret"}
    with pytest.raises(CannotStart) as refused:
        trade.system.start_container(
            "robot", "eyes", command=HERE, environment=environment, ssh_config=sshd.config, wait_s=wait_s
        )
    assert refused.value.reason == "not seen"
    return refused.value


def process_of(error: CannotStart) -> int:
    return int(error.output.split("process ")[1].split(",")[0])


def gone(pid: int) -> bool:
    return not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def test_a_container_that_does_not_join_the_system_is_ended_again(sshd: Sshd) -> None:
    error = stranger(sshd)
    assert error.output.endswith("was not visible here within 1 s, and was ended again")
    wait_until(lambda: gone(process_of(error)))


def test_a_container_that_cannot_be_ended_again_is_named_with_its_place(
    sshd: Sshd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bin").mkdir()
    ours = tmp_path / "bin" / "ssh"
    ours.write_text(f'#!/bin/sh\ncase "$*" in *kill*) exit 255;; esac\nexec {shutil.which("ssh")} "$@"\n')
    ours.chmod(0o755)
    monkeypatch.setenv("PATH", f"{ours.parent}:{os.environ['PATH']}")
    error = stranger(sshd, wait_s=0.0)
    pid = process_of(error)
    assert not gone(pid)
    assert f"it still runs there; to end it: `ssh robot kill {pid}`" in str(error)
    psutil.Process(pid).terminate()
    wait_until(lambda: gone(pid))


def test_another_process_of_that_number_is_not_ended(sshd: Sshd) -> None:
    """`command` may start the container where processes have other numbers, such as in a container of containerd."""
    other = subprocess.Popen(["sleep", "1000"])
    try:
        assert not ssh.end_there("robot", "eyes", other.pid, ["container", "--name", "eyes"], sshd.config)
        assert other.poll() is None
        assert ssh.end_there("robot", "eyes", other.pid, ["sleep", "1000"], sshd.config)
        assert other.wait(10) == -signal.SIGTERM
    finally:
        other.kill()
        other.wait()


def test_what_the_shell_there_prints_by_itself_hides_no_container(sshd: Sshd, tmp_path: Path) -> None:
    talkative = tmp_path / "trade"
    talkative.write_text(f'#!/bin/sh\necho hello\n{shlex.join(HERE)} "$@"\necho bye\n')
    talkative.chmod(0o755)
    started = trade.system.start_container(
        "robot", "eyes", command=(str(talkative),), ssh_config=sshd.config, wait_s=30
    )
    with ended("eyes", started.pid):
        assert started.name == "eyes"


def refused(sshd: Sshd, *command: str) -> CannotStart:
    with pytest.raises(CannotStart) as reported:
        trade.system.start_container("robot", "eyes", command=command or HERE, ssh_config=sshd.config)
    return reported.value


def test_a_host_whose_key_is_not_known_is_not_talked_to_and_stays_unknown(sshd: Sshd) -> None:
    sshd.known_hosts.write_text("")
    error = refused(sshd)
    assert error.reason == "unknown host key"
    assert "known_hosts" in error.remedy
    assert sshd.known_hosts.read_text() == ""


def test_a_host_with_another_key_than_the_known_one_is_not_talked_to(sshd: Sshd) -> None:
    sshd.know("stranger")
    before = sshd.known_hosts.read_text()
    assert refused(sshd).reason == "changed host key"
    assert sshd.known_hosts.read_text() == before


def test_a_login_that_is_refused_asks_for_no_password(sshd: Sshd) -> None:
    sshd.write_config(identity="stranger")
    assert refused(sshd).reason == "not let in"


def test_where_no_sshd_listens_it_is_refused(sshd: Sshd) -> None:
    sshd.close()
    assert refused(sshd).reason == "refused"


def test_a_host_that_says_nothing_is_given_up(sshd: Sshd, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = [word.replace(f"ConnectTimeout={ssh.CONNECT_S}", "ConnectTimeout=1") for word in ssh._ASKED]
    monkeypatch.setattr(ssh, "_ASKED", tuple(asked))
    with socket.create_server(("127.0.0.1", 0)) as mute:
        sshd.write_config(port=mute.getsockname()[1])
        assert refused(sshd).reason == "timeout"


def test_an_unresponsive_host_is_reported_before_the_deadline_of_the_call(
    sshd: Sshd, start_container: Callable[[str], trade.Container]
) -> None:
    """By default the call has as long as ssh waits for a link."""

    class Starter:
        @trade.service
        def start(self) -> None:
            trade.system.start_container("robot", "eyes", ssh_config=sshd.config)

    start_container("starter").register(Starter(), "starter")
    start = trade.find(where(name="start", group="starter"), wait_s=30)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        sshd.write_config(port=mute.getsockname()[1])
        with pytest.raises(CannotStart, match="timeout"):
            start.with_(deadline_s=2.0)()


def test_a_host_without_trade_is_reported(sshd: Sshd) -> None:
    error = refused(sshd, "no-such-trade")
    assert (error.reason, "'no-such-trade' is not found" in error.remedy) == ("no trade there", True)


@pytest.mark.parametrize("host", ["-oProxyCommand=touch x", "", "robot; reboot", "robot reboot", "$(reboot)"])
def test_an_invalid_host_name_never_reaches_ssh(system: str, host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("it ran"))
    with pytest.raises(ConfigurationError, match="is no host"):
        trade.system.start_container(host, "eyes")


def test_arguments_reach_the_remote_shell_unchanged() -> None:
    hostile = "a b; $(reboot) 'x'"
    words = [*ssh._assigned({"TRADE_CONNECT": hostile}), "trade", "--allow", hostile]
    assert shlex.split(ssh.ssh_words("robot", None, words)[-1]) == words
    assert words[:2] == ["env", f"TRADE_CONNECT={hostile}"]
    with pytest.raises(ConfigurationError, match="is no name of a variable"):
        ssh._assigned({"A;B": "1"})
