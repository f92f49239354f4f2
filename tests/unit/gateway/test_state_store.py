"""What is saved survives whatever ends the process, the disk or the file; and it delays no caller."""

import contextlib
import random
import resource
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from trade_gateway.supervisor._store import StateStore

pytestmark = pytest.mark.virtual_time

BIG = "x" * 20_000
"""More than a page, so that a save takes several steps on the disk."""
SAVER = """
import os, signal, sys
from pathlib import Path
from trade_gateway.supervisor._store import StateStore

def states(turn):
    return {f"object {n}": [turn, "x" * 20_000] for n in range(5)}

def save_repeatedly(path):
    store = StateStore(path, print)
    for turn in range(1, 100_000):
        assert store.save("a", states(turn))
        print(turn, flush=True)

def save_twice_and_die(path, step):
    left, store = step, StateStore(path, print)
    def count(frame, event, argument):
        nonlocal left
        left -= event in ("c_call", "c_return")
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
    store.save("a", states(1))
    store._thread.submit(sys.setprofile, count).result()
    saved = store.save("a", states(2))
    os._exit(0 if saved else 1)

if sys.argv[2] == "repeatedly":
    save_repeatedly(Path(sys.argv[1]))
step, code = 0, None
while code != 0:
    step += 1
    child = os.fork()
    if not child:
        save_twice_and_die(Path(sys.argv[1]) / f"{step}.sqlite", step)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(code, flush=True)
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "door.state.sqlite"


@pytest.fixture
def reported() -> list[str]:
    return []


@pytest.fixture
def opened(path: Path, reported: list[str]) -> Iterator[Callable[[], StateStore]]:
    made: list[StateStore] = []

    def open_store() -> StateStore:
        for one in made:
            one.close()
        made.append(StateStore(path, reported.append))
        return made[-1]

    yield open_store
    made[-1].close()


def test_the_last_save_is_available_to_the_next_process(opened: Callable[[], StateStore], reported: list[str]) -> None:
    store = opened()
    assert store.load("a") == {}
    assert store.save("a", {"lamp": {"on": True}, "clock": [1, 2.5, "x", b"y", None]})
    assert store.save("a", {"lamp": {"on": False}})
    assert store.save("b", {"lamp": 3})
    assert opened().load("a") == {"lamp": {"on": False}, "clock": [1, 2.5, "x", b"y", None]}
    assert reported == []


def test_a_table_with_an_extra_column_of_a_later_version_is_still_used(
    opened: Callable[[], StateStore], path: Path, reported: list[str]
) -> None:
    assert opened().save("a", {"lamp": 1})
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("alter table state add column room text")
    store = opened()
    assert store.save("a", {"lamp": 2, "clock": 3})
    assert store.load("a") == {"lamp": 2, "clock": 3}
    assert reported == []


def test_only_its_user_reads_it(opened: Callable[[], StateStore], path: Path) -> None:
    opened().save("a", {"lamp": 1})
    assert (path.stat().st_mode & 0o077, path.parent.stat().st_mode & 0o077) == (0, 0)


@pytest.mark.parametrize("content", [b"nonsense" * 1000, b"SQLite format 3\0" + b"nonsense" * 1000])
def test_a_file_that_is_no_database_is_moved_aside_and_a_fresh_one_is_begun(
    opened: Callable[[], StateStore], path: Path, reported: list[str], content: bytes
) -> None:
    path.parent.mkdir()
    for number in (1, 2):
        path.write_bytes(content)
        store = opened()
        assert store.load("a") == {}
        assert store.save("a", {"lamp": number})
        assert store.load("a") == {"lamp": number}
        store.close()
        assert path.with_name(f"{path.name}.corrupt-{number}").read_bytes() == content
    assert [text.count("is corrupt") for text in reported] == [1, 1]


def test_a_database_with_pages_gone_bad_is_moved_aside(
    opened: Callable[[], StateStore], path: Path, reported: list[str]
) -> None:
    store = opened()
    store.save("a", {f"lamp {n}": BIG for n in range(20)})
    store.close()
    whole = path.read_bytes()
    path.write_bytes(whole[:4096] + random.Random(1).randbytes(len(whole) - 4096))
    assert opened().load("a") == {}
    assert "corrupt-1" in reported[0]


def test_without_its_folder_it_says_so_once_and_again_when_there_is_one(
    opened: Callable[[], StateStore], path: Path, reported: list[str]
) -> None:
    path.parent.write_text("a file, where a folder should be")
    store = opened()
    for _ in range(3):
        assert not store.save("a", {"lamp": 1})
        assert store.load("a") == {}
    assert [text.startswith("no state is saved: ") for text in reported] == [True]
    path.parent.unlink()
    assert store.save("a", {"lamp": 1})
    assert reported[1:] == [f"state is saved again: {path}"]
    assert store.load("a") == {"lamp": 1}


def test_on_a_full_disk_the_last_save_is_kept_and_saving_resumes_when_there_is_room(
    opened: Callable[[], StateStore], reported: list[str]
) -> None:
    store = opened()
    assert store.save("a", {"lamp": 1})
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (64 * 1024, hard))
        for _ in range(2):
            assert not store.save("a", {"lamp": "x" * 1_000_000})
        assert len(reported) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert store.load("a") == {"lamp": 1}
    assert store.save("a", {"lamp": 2})
    assert reported[1].startswith("state is saved again")


def test_a_file_that_another_process_has_locked_costs_a_save_and_no_more(
    opened: Callable[[], StateStore], path: Path, reported: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert opened().save("a", {"lamp": 1})
    with monkeypatch.context() as impatient:
        impatient.setattr("trade.storage._WAIT_S", 1.0)
        store = opened()
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("begin immediate")
        assert not store.save("a", {"lamp": 2})
        other.execute("rollback")
        other.close()
    assert store.save("a", {"lamp": 3})
    assert store.load("a") == {"lamp": 3}
    assert [text.split(":")[0].split(" again")[0] for text in reported] == ["no state is saved", "state is saved"]


def _saver(path: Path, how: str) -> "subprocess.Popen[str]":
    words = [sys.executable, "-c", SAVER, str(path), how]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)


def _whole(path: Path) -> int:
    """The turn that all objects are of."""
    reported: list[str] = []
    store = StateStore(path, reported.append)
    states = store.load("a")
    store.close()
    assert reported == []
    assert len(states) == 5
    [turn] = {state[0] for state in states.values()}
    return turn


@pytest.mark.realtime
def test_killed_at_each_step_of_a_save_the_last_complete_save_is_kept(tmp_path: Path) -> None:
    *killed, done = _saver(tmp_path, "step by step").communicate(timeout=100)[0].split()
    assert (set(killed), done) == ({str(-signal.SIGKILL)}, "0")
    outcomes = [_whole(tmp_path / f"{step}.sqlite") for step in range(1, len(killed) + 2)]
    assert set(outcomes) == {1, 2}
    assert outcomes == sorted(outcomes)


@pytest.mark.realtime
def test_killed_at_any_moment_every_confirmed_save_is_kept(tmp_path: Path) -> None:
    path, dice = tmp_path / "state.sqlite", random.Random(7)
    for _ in range(4):
        child = _saver(path, "repeatedly")
        assert child.stdout is not None
        said = [int(child.stdout.readline()) for _ in range(dice.randrange(3, 30))]
        child.kill()
        said += [int(line) for line in child.stdout.read().split("\n") if line]
        child.wait(60)
        child.stdout.close()
        assert _whole(path) in (said[-1], said[-1] + 1)
