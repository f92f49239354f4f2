"""The runtime folder is one for all processes of a user, whatever their environment says."""

import os
import tempfile
from pathlib import Path

import pytest

from trade._paths import runtime_folder, runtime_folders
from trade.errors import ConfigurationError
from trade.transport.credentials import user_secret
from trade.transport.host_socket import host_sockets, listen_on_host

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A host with ``/run/user`` and ``/tmp``, and no settings."""
    for place in ("run", "tmp"):
        (tmp_path / place).mkdir()
    monkeypatch.setattr("trade._paths._OF_LOGINS", tmp_path / "run")
    monkeypatch.setattr("trade._paths._ALWAYS", tmp_path / "tmp")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    for name in ("TRADE_RUNTIME_DIR", "XDG_RUNTIME_DIR"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def log_in(host: Path) -> Path:
    """What a session manager does at the first login."""
    folder = host / "run" / str(os.getuid())
    folder.mkdir(mode=0o700)
    return folder


@pytest.mark.parametrize("logged_in", [True, False])
def test_processes_of_one_user_use_one_folder_with_and_without_variables(
    host: Path, logged_in: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as a shell, ``ssh`` with a command, cron, and sudo."""
    if logged_in:
        log_in(host)
    before = runtime_folder()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(host / "other"))
    monkeypatch.setenv("TMPDIR", str(host / "other"))
    monkeypatch.setattr(tempfile, "tempdir", str(host / "other"))
    assert runtime_folder() == before
    monkeypatch.setenv("TRADE_RUNTIME_DIR", str(host / "named"))  # control: this one counts, and alone
    assert runtime_folders() == [host / "named" / "trade"]


@pytest.mark.real_clock
@pytest.mark.parametrize("first", ["logged out", "logged in"])
def test_a_robot_that_started_before_a_login_is_found_after_it(host: Path, first: str) -> None:
    folder = log_in(host) if first == "logged in" else host
    opened = listen_on_host("lab", ".stop-")
    assert opened is not None
    server, path = opened
    secret = user_secret()
    if first == "logged out":
        log_in(host)
    else:
        folder.rename(host / "away")  # the folder of an earlier login is not there any more
        path = host / "away" / "trade" / "lab" / path.name
    with server:
        assert host_sockets("lab", ".stop-") == ([path] if first == "logged out" else [])
        assert user_secret() == secret
    path.unlink()


@pytest.mark.real_clock
def test_a_robot_of_an_earlier_release_is_found_by_the_variable(host: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_RUNTIME_DIR", str(host / "other"))
    opened = listen_on_host("lab", ".stop-")
    assert opened is not None
    monkeypatch.delenv("TRADE_RUNTIME_DIR")
    assert host_sockets("lab", ".stop-") == []  # control
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(host / "other"))
    with opened[0]:
        assert host_sockets("lab", ".stop-") == [opened[1]]


@pytest.mark.real_clock
def test_a_stop_socket_is_made_in_another_folder_if_the_first_one_is_full(
    host: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = log_in(host) / "trade"
    folder.mkdir(mode=0o700)
    (folder / "lab").write_text("in the way, as a full file system is")
    user_secret()
    opened = listen_on_host("lab", ".stop-")
    assert opened is not None
    with opened[0]:
        assert opened[1].is_relative_to(host / "tmp")
        assert host_sockets("lab", ".stop-") == [opened[1]]
    assert "It is made in another folder" in caplog.text


def test_a_folder_that_others_may_write_is_not_used(host: Path) -> None:
    """Another user may have made it before: the folder of the login is used then, and without one it is refused."""
    planted = host / "tmp" / f"trade-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    with pytest.raises(ConfigurationError, match="others may write there"):
        runtime_folder()
    own = log_in(host)
    assert runtime_folders() == [own / "trade"]
