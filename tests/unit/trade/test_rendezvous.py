"""How containers of one host find each other: a folder with a file for each one's endpoint."""

import fcntl
import os
import re
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from trade import Container, where
from trade._discovery.host_folder import HostFolder
from trade.errors import ConfigurationError
from trade.transport.endpoints import free_endpoint

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def folder(system: str, tmp_path: Path) -> Path:
    HostFolder(system)
    return tmp_path / "runtime" / "trade" / system


@pytest.fixture
def enter(system: str) -> Iterator[Callable[[str], list[str]]]:
    """Enters as another container, which lives until the end of the test; returns what it sees."""
    entered: list[HostFolder] = []

    def enter(endpoint: str) -> list[str]:
        entered.append(HostFolder(system))
        return entered[-1].enter(endpoint)

    yield enter
    for one in entered:
        one.leave()


def write(folder: Path, endpoint: str) -> Path:
    """The file of an earlier release, which keeps no lock."""
    path = folder / "tcp_early"
    path.write_text(f"{endpoint}\n{os.getpid()}\n{time.monotonic()}\n")
    return path


def old(path: Path) -> None:
    """Have it be written long ago."""
    lines = [*path.read_bytes().split(b"\n"), b"", b""]
    path.write_bytes(b"\n".join([*lines[:2], b"-1000.0", *lines[3:]]))
    os.utime(path, (1, 1))


def test_a_container_writes_its_endpoint_and_removes_it(system: str, folder: Path) -> None:
    rendezvous = HostFolder(system)
    assert rendezvous.enter("tcp/127.0.0.1:7450") == []
    assert [path.read_text().split()[0] for path in folder.iterdir()] == ["tcp/127.0.0.1:7450"]
    rendezvous.leave()
    rendezvous.leave()
    assert list(folder.iterdir()) == []


@pytest.mark.real_clock
def test_a_new_container_finds_those_that_listen(system: str, folder: Path, enter: Callable[[str], list[str]]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        endpoint = f"tcp/127.0.0.1:{listening.getsockname()[1]}"
        old(write(folder, endpoint))
        assert enter("tcp/127.0.0.1:1") == [endpoint]


def test_endpoints_without_a_listener_are_pruned(system: str, folder: Path, enter: Callable[[str], list[str]]) -> None:
    old(write(folder, free_endpoint()))
    assert enter("tcp/127.0.0.1:1") == []
    assert [path.read_text().split()[0] for path in folder.iterdir()] == ["tcp/127.0.0.1:1"]


def test_endpoints_of_those_that_are_just_starting_are_kept(
    system: str, folder: Path, enter: Callable[[str], list[str]]
) -> None:
    starting = free_endpoint()
    write(folder, starting)
    assert enter("tcp/127.0.0.1:1") == [starting]


@pytest.mark.parametrize("at_s", [1, 4e9], ids=["forward", "back"])
def test_a_clock_that_is_set_while_containers_start_hides_none(
    system: str, folder: Path, at_s: float, enter: Callable[[str], list[str]]
) -> None:
    """As on a computer that has none of its own and asks the network when it starts."""
    starting = free_endpoint()
    os.utime(write(folder, starting), (at_s, at_s))
    assert enter("tcp/127.0.0.1:1") == [starting]


def test_a_file_of_before_this_host_was_started_is_old(
    system: str, folder: Path, enter: Callable[[str], list[str]]
) -> None:
    endpoint = free_endpoint()
    for entered in ("1e9", "nan", "inf", "-1"):
        (folder / "tcp_early").write_text(f"{endpoint}\n{os.getpid()}\n{entered}\n")
        assert enter("tcp/127.0.0.1:1") == []


@pytest.mark.realtime
def test_endpoints_of_processes_that_were_killed_are_pruned_at_once(
    system: str, folder: Path, start_program: Any, enter: Callable[[str], list[str]]
) -> None:
    program = start_program(
        """
        container = Container(Settings.read(container="there"))
        say("up")
        hear()
        """
    )
    assert program.heard() == "up"
    [path] = folder.glob("tcp_*")
    program.kill()
    assert path.exists()
    assert enter("tcp/127.0.0.1:1") == []
    assert not path.exists()


@pytest.mark.parametrize("writer", ["", "\nrubbish", "\n1"])
def test_where_it_is_not_known_whether_the_writer_lives_the_file_counts_as_young(
    system: str, folder: Path, writer: str, monkeypatch: pytest.MonkeyPatch, enter: Callable[[str], list[str]]
) -> None:
    def refuse(pid: int, signal: int) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "kill", refuse)  # another user's process
    endpoint = free_endpoint()
    (folder / "tcp_early").write_text(endpoint + writer)
    assert enter("tcp/127.0.0.1:1") == [endpoint]


@pytest.mark.real_clock
def test_endpoints_on_the_newer_loopback_address_are_not_pruned(
    system: str, folder: Path, enter: Callable[[str], list[str]]
) -> None:
    if not socket.has_ipv6:
        pytest.skip("this host has no IPv6")
    try:
        listening = socket.create_server(("::1", 0), family=socket.AF_INET6)
    except OSError:
        pytest.skip("this host has no IPv6 loopback")
    with listening:
        endpoint = f"tcp/[::1]:{listening.getsockname()[1]}"
        old(write(folder, endpoint))
        assert enter("tcp/127.0.0.1:1") == [endpoint]


def test_foreign_files_in_the_folder_disturb_nothing(
    system: str, folder: Path, enter: Callable[[str], list[str]]
) -> None:
    (folder / "tcp_rubbish").write_bytes(b"\xff\x00")
    (folder / "tcp_more").write_text("not an endpoint")
    (folder / "tcp_folder").mkdir()
    old(folder / "tcp_rubbish")
    old(folder / "tcp_more")
    assert enter("tcp/127.0.0.1:1") == []


@pytest.mark.real_clock
def test_a_container_takes_its_files_away(here: Container, folder: Path) -> None:
    assert sorted(re.split("[-_]", path.name)[0] for path in folder.iterdir()) == [".calls", "tcp"]
    here.close()
    assert list(folder.iterdir()) == []


def test_the_folder_is_the_users_own(folder: Path) -> None:
    assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.real_clock
def test_a_folder_that_others_may_write_is_refused(system: str, tmp_path: Path) -> None:
    shared = tmp_path / "runtime" / "trade"
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    with pytest.raises(ConfigurationError, match="others may write there; remove it, or set TRADE_RUNTIME_DIR"):
        Container()


def test_a_folder_that_is_a_link_is_refused(system: str, tmp_path: Path) -> None:
    (tmp_path / "runtime").mkdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    (tmp_path / "runtime" / "trade").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigurationError, match="others may write there"):
        HostFolder(system)


@pytest.mark.realtime
def test_containers_that_start_at_the_same_moment_see_each_other(start_program: Any, system: str) -> None:
    source = """
        for round in range(10):
            hear()
            with Container(Settings.read(system=f"{sys.argv[1]}-{round}", container=sys.argv[2])) as container:
                other = container.find(where(name="clock", container=sys.argv[3]), wait_s=30)
                say(other() > 0)
                hear()
    """
    pair = [start_program(source, system, "one", "other"), start_program(source, system, "other", "one")]
    for _ in range(10):
        for program in pair:
            program.tell()
        assert [program.heard() for program in pair] == ["True", "True"]
        for program in pair:
            program.tell()
    assert [program.ends() for program in pair] == [0, 0]


@pytest.mark.real_clock
def test_of_those_that_enter_at_the_same_moment_the_later_ones_see_the_earlier_ones_only(system: str) -> None:
    """So no two dial each other: each would refuse the other's link."""
    many = 12
    folders, together, seen = [HostFolder(system) for _ in range(many)], threading.Barrier(many), [0] * many

    def enter(place: int) -> None:
        together.wait()
        seen[place] = len(folders[place].enter(f"tcp/127.0.0.1:{place + 1}"))

    threads = [threading.Thread(target=enter, args=(place,)) for place in range(many)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    by_time = sorted(range(many), key=lambda place: folders[place].entered_ns)
    assert [seen[place] for place in by_time] == list(range(many))
    for folder in folders:
        folder.leave()


@pytest.mark.real_clock
def test_a_container_enters_though_another_one_is_frozen_while_it_does(system: str, folder: Path) -> None:
    frozen = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(frozen, fcntl.LOCK_EX)
        rendezvous = HostFolder(system)
        assert rendezvous.enter("tcp/127.0.0.1:7450") == []
        assert [path.name for path in folder.iterdir()] == ["tcp_127.0.0.1_7450"]
        rendezvous.leave()
    finally:
        os.close(frozen)


@pytest.mark.real_clock
def test_the_session_of_a_container_has_the_moment_at_which_it_entered(folder: Path) -> None:
    with Container() as here:
        [path] = folder.glob("tcp_*")
        written_us = float(path.read_text().split("\n")[2]) * 1e6
        began_us = int.from_bytes(bytes.fromhex(str(here._parts.transport._session.zid()))[-6:], "little") - (1 << 47)
    assert written_us - 60e6 < began_us <= written_us


def test_a_known_container_that_does_not_listen_yet_is_dialled_until_it_does(
    here: Container, start_container: Any, enter: Callable[[str], list[str]]
) -> None:
    """Its file was there first; it read the folder before ours was."""
    endpoint = free_endpoint()
    enter(endpoint)
    early = start_container("early")
    late = start_container("late", listen=[endpoint], connect=[free_endpoint()])
    assert early.find(where(name="clock", container="late"), wait_s=30)() > 0
    assert late.find(where(name="clock", container="early"), wait_s=30)() > 0


def test_a_living_container_keeps_its_file_though_it_does_not_accept(
    folder: Path, enter: Callable[[str], list[str]]
) -> None:
    """As while strangers flood it with connections, or for a program in another process namespace."""
    endpoint = free_endpoint()
    enter(endpoint)
    [path] = folder.iterdir()
    path.write_text(path.read_text().replace(f"{os.getpid()}", "4194400"))  # no process of this namespace
    old(path)
    assert enter("tcp/127.0.0.1:1") == [endpoint]
    assert path.exists()


@pytest.mark.parametrize("emptied", ["folder", "file", "replaced"])
def test_a_file_that_vanished_is_written_again(
    system: str, folder: Path, enter: Callable[[str], list[str]], emptied: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A session manager empties the folder at the last logout."""
    rendezvous = HostFolder(system)
    rendezvous.enter("tcp/127.0.0.1:7450")
    rendezvous.keep()
    assert not caplog.records  # control: nothing has happened
    [path] = folder.iterdir()
    if emptied == "folder":
        shutil.rmtree(folder.parent)
    else:
        path.unlink()
    if emptied == "replaced":
        write(folder, "tcp/127.0.0.1:7451").rename(path)
    rendezvous.keep()
    rendezvous.keep()
    assert "has vanished, and is written again" in caplog.messages[0]
    assert len(caplog.records) == 1
    assert enter("tcp/127.0.0.1:1") == ["tcp/127.0.0.1:7450"]
    rendezvous.leave()
    rendezvous.keep()
    assert not path.exists()


def test_a_container_that_could_not_write_its_file_tries_again(
    system: str, folder: Path, enter: Callable[[str], list[str]], caplog: pytest.LogCaptureFixture
) -> None:
    rendezvous = HostFolder(system)
    folder.rmdir()
    folder.write_text("in the way")
    rendezvous.enter("tcp/127.0.0.1:7450")
    for _ in range(3):
        rendezvous.keep()
    assert len(caplog.records) == 1
    folder.unlink()
    rendezvous.keep()
    assert enter("tcp/127.0.0.1:1") == ["tcp/127.0.0.1:7450"]
    rendezvous.leave()
