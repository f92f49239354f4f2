"""Real time: a process takes it where it may, and loses it if it keeps a processor busy."""

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from shutil import which

import pytest

from trade_gateway.cli.hardware import _doctor_host as host
from trade_gateway.process import _real_time
from trade_gateway.process._real_time import PRIORITY, RealTime, refusal

pytestmark = pytest.mark.virtual_time

may = pytest.mark.skipif(bool(refusal()), reason=refusal() or "it may")

HURRY = """
import os, threading
from trade_gateway.process._real_time import RealTime

def policies():
    return {os.sched_getscheduler(int(task)) for task in os.listdir("/proc/self/task")}

ended = threading.Event()
threading.Thread(target=ended.wait, daemon=True).start()
real_time = RealTime()
print(real_time.take(), policies() == {os.SCHED_FIFO}, flush=True)
threading.Thread(target=ended.wait, daemon=True).start()
print(policies() == {os.SCHED_FIFO}, os.sched_getparam(0).sched_priority, flush=True)
"""

COMPUTES = """
import time
def compute():
    while not ended.is_set():
        pass
threading.Thread(target=compute).start()
until = time.monotonic() + 60
while policies() != {os.SCHED_OTHER} and time.monotonic() < until:
    time.sleep(0.1)
    real_time.watch()
print(policies() == {os.SCHED_OTHER})
ended.set()
"""

HOLDS_THE_INTERPRETER = """
threading.Thread(target=lambda: sum(range(10**15)), daemon=True).start()
ended.wait(90)
print("not killed")
"""


def run(program: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100, check=False)


@pytest.mark.realtime
@may
def test_all_threads_of_a_process_are_in_real_time_and_those_that_begin_later() -> None:
    done = run(HURRY)
    first, second = done.stdout.splitlines()
    assert (done.stderr, first.endswith(" True"), second) == ("", True, f"True {PRIORITY}")


@pytest.mark.realtime
@may
def test_a_thread_that_computes_without_end_makes_the_whole_process_ordinary() -> None:
    done = run(HURRY + COMPUTES)
    assert done.stdout.splitlines()[-1] == "True"
    assert "of a processor for seconds; it is no longer in real time" in done.stderr


@pytest.mark.realtime
@may
def test_a_thread_that_holds_the_interpreter_for_seconds_ends_the_process() -> None:
    done = run(HURRY + HOLDS_THE_INTERPRETER)
    assert (done.returncode, "not killed" in done.stdout) == (-signal.SIGKILL, False)


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)


@pytest.mark.usefixtures("refused")
def test_a_process_that_may_not_stays_ordinary_and_gives_the_reason() -> None:
    before = resource.getrlimit(resource.RLIMIT_RTTIME)
    assert RealTime().take() == ["the operating system refuses SCHED_FIFO: Operation not permitted"]
    assert resource.getrlimit(resource.RLIMIT_RTTIME) == before
    [found] = host.real_time(())
    assert (found.level, found.about) == ("warning", "real time")
    assert f"- rtprio {PRIORITY}" in found.fix


@pytest.mark.usefixtures("refused")
@pytest.mark.parametrize(
    ("user", "needs"), [(0, "--cap-add SYS_NICE"), (10001, f"--ulimit rtprio={PRIORITY}")], ids=["root", "a user"]
)
def test_in_a_container_the_remedy_is_an_option_of_its_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, user: int, needs: str
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: user)
    mark = tmp_path / ".containerenv"
    mark.touch()
    [found] = host.real_time([tmp_path / ".dockerenv", mark])
    assert found.fix == f"start the container with {needs} --ulimit memlock=-1"


_WITH_SYS_NICE = ("setpriv", "--bounding-set=-all,+sys_nice", "--inh-caps=-all", "--no-new-privs")
_NOBODY = ("--reuid=65534", "--regid=65534", "--clear-groups")


@pytest.mark.realtime
@may
@pytest.mark.skipif(os.getuid() != 0 or which("setpriv") is None, reason="needs root, and setpriv")
@pytest.mark.parametrize(("user", "allowed"), [((), True), (_NOBODY, False)], ids=["root", "a user"])
def test_the_right_of_a_container_is_one_of_its_root_only(user: tuple[str, ...], allowed: bool) -> None:
    command = ("prlimit", "--rtprio=0", *_WITH_SYS_NICE, *user, "chrt", "--fifo", str(PRIORITY), "true")
    assert (subprocess.run(command, capture_output=True, timeout=60, check=False).returncode == 0) is allowed


def test_a_system_without_it_gives_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    assert RealTime().take() == ["this operating system has no SCHED_FIFO"]


def test_a_thread_that_has_ended_meanwhile_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / str(2**22)).touch()  # more than the greatest number of a thread
    monkeypatch.setattr(_real_time, "_THREADS", tmp_path)
    _real_time._schedule(os.SCHED_OTHER, 0)
