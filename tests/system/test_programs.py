"""Programs of any kind under a supervisor: they crash, fork, flood their log, ignore SIGTERM; judged from outside."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from tests.support.waiting import wait_until
from tests.system.supervised import Keeping

PYTHON = f"program = ['{sys.executable}', '-c', '''\n%s\n''']\n"
MARK = "MARK_OF_TEST"
ESCAPES = """
import os, signal, time
if os.fork() == 0:
    os.setsid()  # a session of its own, and its parent ends: it has left the process group
    if os.fork() == 0:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(600)
    os._exit(0)
os.wait()
"""


@pytest.fixture
def marked(tmp_path: Path) -> Iterator[Callable[[], list[psutil.Process]]]:
    """The processes of the test's programs, found by a variable that all of them inherit."""

    def processes() -> list[psutil.Process]:
        return [one for one in psutil.process_iter() if _has_mark(one, str(tmp_path))]

    yield processes
    for left in processes():
        left.kill()


def _has_mark(process: psutil.Process, mark: str) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE and process.environ().get(MARK) == mark
    except psutil.Error:
        return False


def table(tmp_path: Path, code: str, more: str = "") -> str:
    return f"[container.a]\n{PYTHON % code}env = {{ {MARK} = '{tmp_path}' }}\n{more}"


def test_a_program_that_ends_at_once_is_given_up_with_its_last_words(
    keeping: Callable[..., Keeping], tmp_path: Path
) -> None:
    kept = keeping(table(tmp_path, 'import sys; sys.exit("no map")', "restarts = 1\n"))
    given_up = kept.become("a", "given up")
    assert (given_up.restarts, given_up.why) == (1, "ended (exit code 1: no map)")
    assert not [text for text in kept.texts() if "is up" in text]


def test_a_killed_program_is_back_in_its_folder_with_its_variables(
    keeping: Callable[..., Keeping], tmp_path: Path
) -> None:
    (tmp_path / "work").mkdir()
    said = f"print(os.getcwd(), os.environ['{MARK}'], os.environ['TRADE_SYSTEM'], flush=True)"
    code = f"import os, time; {said}; time.sleep(600)"
    kept = keeping(table(tmp_path, code, "folder = 'work'\n"))
    first = kept.become("a", "up")
    os.kill(first.pid, signal.SIGKILL)
    again = kept.become("a", "up", restarts=1)
    assert again.pid != first.pid
    log = tmp_path / "kept" / "logs" / "a.log"
    assert log.read_text() == f"{tmp_path}/work {tmp_path} {kept.system}\n"
    assert kept.texts()[1].startswith("a crashed (signal 9")


@pytest.mark.parametrize("kill", ["the program", "its runner"])
def test_forked_children_end_with_their_program(
    keeping: Callable[..., Keeping], tmp_path: Path, marked: Callable[[], list[psutil.Process]], kill: str
) -> None:
    code = "import os, time\nos.fork()\nif os.fork() == 0: os.setsid()\ntime.sleep(600)"
    kept = keeping(table(tmp_path, code, "grace_s = 0.5\n"))
    first = kept.become("a", "up")
    before = {one.pid for one in marked()}
    runner = psutil.Process(first.pid).ppid()
    assert len(before - {runner}) == 4
    os.kill(first.pid if kill == "the program" else runner, signal.SIGKILL)
    kept.become("a", "up", restarts=1)
    wait_until(lambda: not before & {one.pid for one in marked()}, "all of the first start have ended")
    kept.supervisor.close()
    assert marked() == []


def test_a_program_that_goes_into_the_background_is_given_up_and_leaves_no_process(
    keeping: Callable[..., Keeping], tmp_path: Path, marked: Callable[[], list[psutil.Process]]
) -> None:
    kept = keeping(table(tmp_path, ESCAPES, "restarts = 0\ngrace_s = 0.5\n"))
    given_up = kept.become("a", "given up")
    assert given_up.why.startswith("ended (exit code 0: trade: ")
    assert "run it in the foreground" in (tmp_path / "kept" / "logs" / "a.log").read_text()
    assert marked() == []


def test_a_program_that_escapes_and_ignores_sigterm_is_killed_after_its_grace(
    keeping: Callable[..., Keeping], tmp_path: Path, marked: Callable[[], list[psutil.Process]]
) -> None:
    code = f"{ESCAPES}\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\ntime.sleep(600)"
    kept = keeping(table(tmp_path, code, "grace_s = 0.5\n"))
    kept.become("a", "up")
    assert len(marked()) == 3
    kept.supervisor.close()
    assert marked() == []
    assert "trade: not ended 0.5 s after SIGTERM, so it is killed" in kept.texts()[-1]


def test_a_flood_of_output_keeps_two_logs_of_limited_size(keeping: Callable[..., Keeping], tmp_path: Path) -> None:
    code = "import time\nfor n in range(60000): print(f'{n:099}')\nprint('all of it', flush=True)\ntime.sleep(600)"
    kept = keeping(table(tmp_path, code, "log_mb = 0.5\n"))
    kept.become("a", "up")
    logs = tmp_path / "kept" / "logs"
    wait_until(lambda: "all of it" in (logs / "a.log").read_text(), "it has printed 6 MB")
    sizes = {path.name: path.stat().st_size for path in logs.iterdir()}
    assert sizes.keys() == {"a.log", "a.1.log"}
    assert all(size <= 500_000 for size in sizes.values())
    assert f"{59999:099}" in (logs / "a.log").read_text()


def test_a_program_whose_health_command_fails_is_started_again(keeping: Callable[..., Keeping], tmp_path: Path) -> None:
    well = tmp_path / "well"
    health = "health = { command = ['test', '-e', 'well'], every_s = 0.1, within_s = 0.1 }\n"
    kept = keeping(table(tmp_path, "import time; time.sleep(600)", health))
    wait_until(lambda: (kept.child("a") or kept.become("a", "starting")).pid > 0)
    assert kept.become("a", "starting").why == ""
    well.touch()
    first = kept.become("a", "up")
    well.unlink()
    wait_until(lambda: not psutil.pid_exists(first.pid), "it is ended")
    well.touch()
    kept.become("a", "up", restarts=1)
    assert "a is asked to shut down: its health command failed 4 times in a row" in kept.texts()


def test_a_program_ends_with_its_supervisor_even_after_kill_9(
    run: Callable[..., object], system: str, tmp_path: Path, marked: Callable[[], list[psutil.Process]]
) -> None:
    file = tmp_path / "gateway.toml"
    file.write_text(f'system = "{system}"\n{table(tmp_path, ESCAPES + "time.sleep(600)", "grace_s = 0.5")}')
    gateway = run("-m", "trade_gateway", "gateway", file, "--json")
    gateway.wait_for(lambda said: said.get("state") == "up")
    assert len(marked()) == 3
    gateway.signal(signal.SIGKILL)
    wait_until(lambda: marked() == [], "all of it has ended")


def test_a_container_that_a_program_announces_is_its_sign_of_life(
    keeping: Callable[..., Keeping], tmp_path: Path
) -> None:
    code = "import time, trade; trade.services(); time.sleep(600)"
    kept = keeping(table(tmp_path, code, "announces = 'b'\nanswers_within_s = 1\ngrace_s = 0.5\n"))
    hung = kept.become("a", "up")
    assert [info.pid for info in kept.member.containers() if info.name == "b"] == [hung.pid]
    os.kill(hung.pid, signal.SIGSTOP)
    again = kept.become("a", "up", restarts=1)
    assert "a is asked to shut down: it did not answer within 1 s" in kept.texts()
    os.kill(again.pid, signal.SIGKILL)
    last = kept.become("a", "up", restarts=2)
    wait_until(lambda: [info.pid for info in kept.member.containers() if info.name == "b"] == [last.pid])
