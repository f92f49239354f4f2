"""Who is not of the system is not linked, and sees nothing."""

import logging
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until_dialled
from trade import Container, Settings, service, where
from trade.errors import CannotConnect, ConfigurationError, NoSuchService
from trade.transport.credentials import user_secret
from trade.transport.endpoints import free_endpoint
from trade.transport.zenoh import ZenohTransport

pytestmark = pytest.mark.realtime

ALICE = ("alice", "pass:word")
OTHERS = [("alice", "wrong"), ("bob", "pass:word"), None]


class Echo:
    @service(effect="read")
    def echo(self, value: int) -> int:
        return value


def peers(container: Container) -> int:
    assert isinstance(container._parts.transport, ZenohTransport)
    return len(container._parts.transport._session.info.peers_zid())


@pytest.mark.parametrize("first", [0, 1], ids=["dialling", "dialled"])
@pytest.mark.parametrize("credentials", OTHERS, ids=str)
def test_a_container_with_other_credentials_is_not_linked_and_sees_nothing(
    start_container: Any, credentials: tuple[str, str] | None, first: int
) -> None:
    settings = [{"credentials": ALICE}, {"credentials": credentials}]
    containers = [start_container(f"c{number}", **settings[number]) for number in (first, 1 - first)]
    for container in containers:
        container.register(Echo(), "robot")
    for container in containers:
        with pytest.raises(NoSuchService):
            container.find(where(name="echo", local=False), wait_s=1.2)
        assert len(container.containers()) == 1
        assert peers(container) == 0


def test_a_container_with_the_same_credentials_is_linked(start_container: Any) -> None:
    one, other = (start_container(name, credentials=ALICE) for name in ("one", "other"))
    one.register(Echo(), "robot")
    assert other.find(where(name="echo"), wait_s=20)(3) == 3


def test_an_endpoint_that_refuses_us_is_warned_of(start_container: Any, caplog: pytest.LogCaptureFixture) -> None:
    endpoint = free_endpoint()
    start_container("there", credentials=ALICE, listen=[endpoint])
    outsider = start_container("outsider", credentials=("alice", "wrong"), connect=[endpoint])
    with caplog.at_level(logging.WARNING, "trade"):
        wait_until_dialled(outsider)
    assert f"no link was made in time (tried {endpoint.partition('/')[2]} (accepts connections" in caplog.text
    refused = r"\(accepts connections, but not this container\)\); a link takes the same user and password at both ends"
    with pytest.raises(CannotConnect, match=refused):
        outsider.system.connect(endpoint)


def test_an_endpoint_that_lets_us_in_is_not_warned_of(start_container: Any, caplog: pytest.LogCaptureFixture) -> None:
    endpoint = free_endpoint()
    start_container("there", listen=[endpoint])
    visitor = start_container("visitor", connect=[endpoint])
    with caplog.at_level(logging.WARNING, "trade"):
        wait_until_dialled(visitor)
    assert caplog.text == ""


def test_discovery_does_not_link_containers_with_different_credentials(start_container: Any) -> None:
    one = start_container("one", credentials=ALICE)
    other = start_container("other", credentials=("alice", "wrong"))
    one.system.set_broadcast(True)
    other.system.set_discovery(True)
    with pytest.raises(NoSuchService):
        other.find(where(name="clock", container="one"), wait_s=1.5)


def test_containers_of_one_user_share_a_secret_readable_only_by_that_user(here: Container, tmp_path: Path) -> None:
    secret = tmp_path / "runtime" / "trade" / "@secret"
    assert secret.stat().st_mode & 0o077 == 0
    assert user_secret() == user_secret()
    assert len(user_secret()[1]) > 40


def test_another_user_cannot_join_through_the_loopback_port(
    here: Container, system: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another user has another runtime folder, and so another secret."""
    [entry] = (tmp_path / "runtime" / "trade" / system).glob("tcp_*")
    endpoint = entry.read_text().split()[0]
    monkeypatch.setenv("TRADE_RUNTIME_DIR", str(tmp_path / "elsewhere"))
    with Container(Settings.read(container="intruder", connect=[endpoint])) as intruder:
        with pytest.raises(NoSuchService):
            intruder.find(where(name="clock", container="here"), wait_s=1.2)
        assert peers(intruder) == peers(here) == 0


def test_a_secret_that_others_can_read_is_refused(here: Container, tmp_path: Path) -> None:
    (tmp_path / "runtime" / "trade" / "@secret").chmod(0o644)
    with pytest.raises(ConfigurationError, match="must belong to this user alone; remove it"):
        Container(Settings.read(container="second"))


def test_no_file_with_a_password_stays_behind(start_container: Any, tmp_path: Path) -> None:
    start_container("one", credentials=ALICE).system.set_broadcast(True)
    texts = [path.read_text() for path in (tmp_path / "runtime").rglob("*") if path.is_file()]
    assert not any("pass:word" in text for text in texts)


@pytest.mark.parametrize("credentials", [("a:b", "c"), ("a", "b\nc"), ("a", " b"), ("", "b"), ("a", "")], ids=repr)
def test_credentials_that_are_not_printable_are_refused(credentials: tuple[str, str]) -> None:
    with pytest.raises(ConfigurationError, match="user and password must be printable"):
        Settings.read(environment={}, credentials=credentials)


LAN = ["tcp/192.168.1.5:7450"]


@pytest.mark.parametrize("missing", [{"system": "lab"}, {"credentials": ALICE}, {}], ids=str)
def test_S21_a_laboratory_network_needs_a_system_and_also_credentials(missing: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match="TRADE_INSECURE_LAN needs an explicit system id and credentials"):
        Settings.read(environment={"TRADE_INSECURE_LAN": "1"}, listen=LAN, **missing)


def test_S21_a_laboratory_network_is_listened_on_only_on_purpose() -> None:
    settings = Settings.read(environment={"TRADE_INSECURE_LAN": "1"}, listen=LAN, system="lab", credentials=ALICE)
    assert settings.listen == tuple(LAN)
    for environment in ({}, {"TRADE_INSECURE_LAN": "0"}, {"TRADE_INSECURE_LAN": ""}):
        with pytest.raises(ConfigurationError, match="beyond loopback requires certificates"):
            Settings.read(environment=environment, listen=LAN, system="lab", credentials=ALICE)


@pytest.mark.parametrize(("credentials", "seen"), [("alice:pass:word", True), ("alice:wrong", False), ("", False)])
def test_the_command_line_lists_containers_only_with_their_credentials(
    start_container: Any, monkeypatch: pytest.MonkeyPatch, credentials: str, seen: bool
) -> None:
    start_container("there", credentials=ALICE)
    monkeypatch.setenv("TRADE_CREDENTIALS", credentials)
    command = [sys.executable, "-m", "trade_gateway", "containers", "--json"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert ("there" in ended.stdout) == seen


def test_settings_do_not_show_the_password() -> None:
    settings = Settings.read(container="desk", system="lab", credentials=("lab", "wide-open-sesame"))
    assert settings.credentials == ("lab", "wide-open-sesame")
    assert "sesame" not in f"{settings!r} {settings}"
