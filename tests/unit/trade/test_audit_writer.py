"""Writing a record down: what waits, what is lost, and the bad days of disks and clocks."""

import logging
import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import trade._audit.writer as writing
from trade._audit.events import Event
from trade._audit.hash_chain import AuditRow, ChainCheck, verify
from trade._audit.store import AuditStore, Retention, moved_aside_in, reading
from trade._audit.writer import AuditWriter

pytestmark = pytest.mark.virtual_time

Eventually = Callable[[Callable[[], bool]], bool]
KEEP = Retention(90, 1_000_000)


def event(what: str = "rosie.step", at_ns: int = 1) -> Event:
    return Event(at_ns, 1, "call", what, "", "anna", "anna/mind/1", 7, 3, "ok", "", 5)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "audit" / "arm.sqlite"


Write = Callable[..., AuditWriter]


@pytest.fixture
def write(path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Write]:
    monkeypatch.setattr(writing, "_GATHER_S", 0.001)
    monkeypatch.setattr(writing, "_AGAIN_S", 0.01)
    started: list[AuditWriter] = []

    def start(**options: object) -> AuditWriter:
        options.setdefault("keep", KEEP)
        started.append(AuditWriter(path, "boot1", "{}", **options))  # type: ignore[arg-type]
        return started[-1]

    yield start
    for one in started:
        one.close()


def rows(path: Path) -> list[AuditRow]:
    with reading(path) as (_, links):
        return [link.row for link in links]


def verdict(path: Path) -> ChainCheck:
    with reading(path) as (head, links):
        return verify(links, head)


def test_a_record_begins_and_ends_with_its_container(write: Write, path: Path) -> None:
    writer = write()
    writer.tell(event("rosie.step"))
    writer.close()
    assert [row.what for row in rows(path)] == ["began", "rosie.step", "ended"]
    assert verdict(path).problem == ""
    assert path.stat().st_mode & 0o077 == 0
    assert path.parent.stat().st_mode & 0o077 == 0


def test_the_next_boot_continues_the_audit_chain_of_the_last_one(write: Write, path: Path) -> None:
    for _ in range(2):
        write().close()
    assert [row.what for row in rows(path)] == ["began", "ended"] * 2
    assert verdict(path).problem == ""


def test_where_a_record_ends_is_logged_for_who_keeps_logs_elsewhere(
    write: Write, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "trade"):
        write().close()
    assert f"ends at row 2, {verdict(path).head.hash.hex()}" in caplog.text


def test_texts_that_cannot_be_written_are_written_without_what_cannot(write: Write, path: Path) -> None:
    writer = write()
    writer.tell(event("rosie.\udcff" + "x" * 10_000))
    writer.close()
    assert rows(path)[1].what.startswith("rosie.?xxx")
    assert len(rows(path)[1].what) == writing._LONGEST
    assert verdict(path).problem == ""


def test_a_full_audit_queue_blocks_no_caller_and_the_lost_records_are_counted(
    write: Write, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "_MOST", 10)
    inside, go_on = threading.Event(), threading.Event()
    add = AuditStore.add

    def slow(self: AuditStore, new: list[AuditRow]) -> object:
        inside.set()
        assert go_on.wait(30)
        return add(self, new)

    monkeypatch.setattr(AuditStore, "add", slow)
    writer = write()
    assert inside.wait(30)
    for _ in range(25):
        writer.tell(event())
    assert (writer.waiting, writer.lost) == (10, 15)
    go_on.set()
    writer.close()
    assert [row.about for row in rows(path) if row.what == "lost"] == ["15 records that could not be written in time"]
    assert sum(row.kind == "call" for row in rows(path)) == 10
    assert verdict(path).problem == ""


@pytest.mark.parametrize("trouble", ["database or disk is full", "attempt to write a readonly database"])
def test_what_cannot_be_written_waits_until_it_can_and_that_is_said_once(
    trouble: str,
    write: Write,
    path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    eventually: Eventually,
) -> None:
    tries: list[int] = []
    add = AuditStore.add

    def fails_at_first(self: AuditStore, new: list[AuditRow]) -> object:
        tries.append(len(new))
        if len(tries) < 5:
            raise sqlite3.OperationalError(trouble)
        return add(self, new)

    monkeypatch.setattr(AuditStore, "add", fails_at_first)
    writer = write()
    writer.tell(event())
    assert eventually(lambda: writer.written >= 2)
    writer.close()
    assert [row.what for row in rows(path)] == ["began", "rosie.step", "ended"]
    assert caplog.text.count("cannot be written") == 1
    assert trouble in caplog.text
    assert "is written again" in caplog.text


def test_a_writer_closed_as_its_file_can_be_written_again_writes_what_waits_and_ends(
    write: Write,
    path: Path,
    eventually: Eventually,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(writing, "_AGAIN_S", 600)
    path.parent.write_bytes(b"")  # in the place of its folder
    writer = write()
    writer.tell(event())
    assert eventually(lambda: "cannot be written" in caplog.text)
    path.parent.unlink()
    writer.close()
    assert not writer.running
    assert [row.what for row in rows(path)] == ["began", "rosie.step", "ended"]


def test_a_writer_closed_while_another_process_holds_its_file_ends(
    write: Write, path: Path, eventually: Eventually
) -> None:
    writer = write()
    assert eventually(lambda: writer.written == 1)
    holder = sqlite3.connect(path, isolation_level=None)
    try:
        holder.execute("BEGIN IMMEDIATE")
        writer.tell(event())
        writer.close()
        assert not writer.running
    finally:
        holder.close()
    assert [row.what for row in rows(path)] == ["began"]


@pytest.mark.realtime
def test_a_disk_that_is_full_indeed_loses_what_does_not_fit_and_breaks_nothing(path: Path) -> None:
    program = f"""
import resource, logging
logging.basicConfig()
import trade._audit.writer as writing
from trade._audit.events import Event
from trade._audit.store import Retention
from pathlib import Path
writing._AGAIN_S = 0.01
writer = writing.AuditWriter(Path({str(path)!r}), "boot", "", Retention(90, 10**6))
event = Event(1, 1, "call", "rosie." + "x" * 400, "", "anna", "", 7, 3, "ok", "", 5)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
for _ in range(2000):
    writer.tell(event)
while not writer._trouble:
    writer._closing.wait(0.01)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
for _ in range(3):
    writer.tell(event)
while writer.waiting:
    writer._closing.wait(0.01)
writer.close()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "cannot be written" in done.stderr
    assert verdict(path).problem == ""
    assert sum(row.kind == "call" for row in rows(path)) == 2003
    assert moved_aside_in(path.parent) == []


@pytest.mark.realtime
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to mount a disk")
def test_a_disk_without_space_and_a_disk_that_is_read_only(write: Write, path: Path, eventually: Eventually) -> None:
    path.parent.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(path.parent)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("mounts are not allowed here")
    try:
        writer = write()
        assert eventually(lambda: writer.written == 1)
        filler = path.parent / "filler"
        with filler.open("wb", buffering=0) as file, pytest.raises(OSError, match="space"):
            while True:
                file.write(b"x" * 4096)
        writer.tell(event("rosie." + "x" * 400))
        for _ in range(100):
            writer.tell(event("rosie." + "x" * 400))
        assert eventually(lambda: "full" in writer._trouble or "I/O" in writer._trouble)
        filler.unlink()
        assert eventually(lambda: writer.written == 102)
        writer.close()
        subprocess.run(["mount", "-o", "remount,ro", str(path.parent)], check=True)
        writer = write()
        assert eventually(lambda: writer._trouble != "")
        subprocess.run(["mount", "-o", "remount,rw", str(path.parent)], check=True)
        assert eventually(lambda: writer.written == 1)
        writer.close()
        assert verdict(path).problem == ""
    finally:
        subprocess.run(["umount", "-l", str(path.parent)], check=True)


@pytest.mark.parametrize("harm", ["no database", "torn", "head", "row"])
def test_a_broken_record_is_moved_aside_and_a_new_one_says_so(
    harm: str, write: Write, path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    writer = write()
    for _ in range(500):
        writer.tell(event())
    writer.close()
    match harm:
        case "no database":
            path.write_bytes(b"nothing of a database" * 1000)
        case "torn":
            path.write_bytes(path.read_bytes()[:100] + os.urandom(3996))
        case "head":
            _do(path, "DROP TABLE head", "CREATE TABLE head (only_one INTEGER PRIMARY KEY, seq, hash)")
            _do(path, "INSERT INTO head VALUES (1, 3, x'00')")
        case _:
            _do(path, "UPDATE record SET seq = 503 WHERE seq = 502")
    writer = write()
    writer.tell(event("rosie.after"))
    writer.close()
    [aside] = moved_aside_in(path.parent)
    began, *_, after, _ended = rows(path)
    assert (began.seq, began.what) == (1, "began again")
    assert aside.name in began.about
    assert after.what == "rosie.after"
    assert verdict(path).problem == ""
    assert "is broken" in caplog.text


def _do(path: Path, *statements: str) -> None:
    file = sqlite3.connect(path)
    with file:
        for statement in statements:
            file.execute(statement)
    file.close()


def test_an_audit_folder_that_cannot_be_created_blocks_no_caller(
    write: Write, path: Path, caplog: pytest.LogCaptureFixture, eventually: Eventually
) -> None:
    path.parent.write_text("a file where a folder is to be")
    writer = write()
    writer.tell(event())
    assert eventually(lambda: "cannot be written" in caplog.text)
    writer.close()
    assert "1 records" in caplog.text


def test_a_clock_that_is_set_is_written_down(write: Write, path: Path, eventually: Eventually) -> None:
    times = [10**18, 0]
    writer = write(clocks=lambda: (times[0], times[1]))
    assert eventually(lambda: writer.written == 1)
    times[:] = [10**18 + 5 * 10**9, 5 * 10**9]  # both advanced
    writer.tell(event("before"))
    assert eventually(lambda: writer.written == 2)
    times[0] -= 3600 * 10**9
    writer.tell(event("after"))
    writer.close()
    assert [(row.what, row.about) for row in rows(path)[1:4]] == [
        ("before", ""),
        ("clock set", "by -3600.000 s"),
        ("after", ""),
    ]


@pytest.mark.parametrize(("jump_days", "dropped"), [(2, True), (30, False)])
def test_a_clock_that_jumped_far_drops_nothing_for_its_age(
    jump_days: int,
    dropped: bool,
    write: Write,
    path: Path,
    eventually: Eventually,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(writing, "_FAR_NS", 3 * 86_400 * 10**9)
    day_ns = 86_400 * 10**9
    now = [100 * day_ns]
    writer = write(clocks=lambda: (now[0], 0), keep=Retention(1, 10**6, least=0, piece=1))
    assert eventually(lambda: writer.written == 1)
    now[0] += jump_days * day_ns
    for _ in range(20):
        writer.tell(event(at_ns=90 * day_ns))
    assert eventually(lambda: writer.written >= 21 and not writer._to_drop and not writer.waiting)
    writer.close()
    assert (verdict(path).first > 1) is dropped
    assert verdict(path).problem == ""


@pytest.mark.realtime
def test_killed_at_any_step_it_leaves_a_record_that_verifies(path: Path) -> None:
    """The writer is ended by the kernel before and after each thing that it asks of the database."""
    program = f"""
import os, signal, sqlite3, sys
import trade._audit.writer as writing
from trade._audit.hash_chain import verify
from trade._audit.store import AuditStore, Retention, reading
from trade._audit.events import Event
from pathlib import Path
path = Path({str(path)!r})
left = 0
class Counted(sqlite3.Connection):
    def _step(self):
        global left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
    def execute(self, *words):
        self._step()
        found = super().execute(*words)
        self._step()
        return found
    def executemany(self, sql, rows):
        def counted():
            for row in rows:
                self._step()
                yield row
        return super().executemany(sql, counted())
connect = sqlite3.connect
def write():
    sqlite3.connect = lambda *words, **named: connect(*words, factory=Counted, **named)
    store = AuditStore(path)
    row = writing._row_of(Event(1, 1, "call", "rosie.step", "", "anna", "", 7, 3, "ok", "", 5), "boot")
    for _ in range(3):
        store.add([row] * 3)
        store.drop(Retention(1, 4, least=0, piece=2), row)
    store.close()
steps = 0
while True:
    steps += 1
    child = os.fork()
    if not child:
        left = steps
        write()
        os._exit(0)
    ended = os.waitpid(child, 0)[1]
    try:
        with reading(path) as (head, links):
            verdict = verify(links, head)
    except sqlite3.OperationalError as none:
        assert "no such table" in str(none) and steps <= 13, none
    else:
        assert not verdict.problem, verdict
    if not ended:
        break
print(steps, verdict.head.seq)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    steps, rows = map(int, done.stdout.split())
    assert steps > 60
    assert rows > steps  # most of those that were ended had added something


@pytest.mark.parametrize(
    ("session", "who"),
    [
        ("door/guest/1f/clinic:anna.7", "clinic/anna via door"),
        ("door/guest/1f/7", "door"),
        ("door", "door"),
        ("", "door"),
    ],
)
def test_a_row_names_the_client_of_another_system_instead_of_the_door(session: str, who: str) -> None:
    row = writing._row_of(Event(1, 1, "lock", "locked", "", "door", session, 7, 3, "ok", "", 5), "boot")
    assert (row.who, row.session) == (who, session)


@pytest.mark.realtime
def test_its_process_killed_under_load_leaves_a_record_that_verifies_and_can_be_added_to(path: Path) -> None:
    program = f"""
import trade._audit.writer as writing
from trade._audit.store import Retention
from trade._audit.events import Event
from pathlib import Path
writing._GATHER_S = 0.001
writer = writing.AuditWriter(Path({str(path)!r}), "boot", "", Retention(90, 10**6))
event = Event(1, 1, "call", "rosie.step", "", "anna", "", 7, 3, "ok", "", 5)
said = False
while True:
    writer.tell(event)
    if not said and writer.written > 100:
        said = True
        print("writing", flush=True)
"""
    for _ in range(3):
        running = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
        assert running.stdout is not None
        running.stdout.readline()
        running.kill()
        running.wait()
        running.stdout.close()
        assert verdict(path).problem == ""
    assert sum(row.what == "began" for row in rows(path)) == 3
    assert all(row.what != "ended" for row in rows(path))
