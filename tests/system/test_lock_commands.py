"""``trade lock``, ``locks``, ``unlock``, ``resume`` and ``estop`` on a simulated robot, as a user types them."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import trade
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import ROSIES_HEAD, Program, Rosie
from trade import Container, where
from trade.errors import LockedByOther, Stopped
from trade.transport.endpoints import free_endpoint
from trade_hil_sim import events, read_log

Command = Callable[..., subprocess.CompletedProcess[str]]

MOVES = """
import sys, threading, trade
from trade import where
move = trade.find(where(name="move_to", group="rosie.neck.pan"), wait_s=30).with_(deadline_s=30)
threads = [threading.Thread(target=lambda: print("moved", round(move(0.1), 1), flush=True))]  # of another thread, too
for thread in threads:
    thread.start()
    thread.join()
for line in sys.stdin:
    try:
        print("again", round(move(float(line)), 1), flush=True)
    except trade.errors.TradeError as error:
        print(type(error).__name__, flush=True)
sys.exit(7)
"""
WAITS = """
import os, signal, sys, time
def end(number, frame):
    os.write(1, f"got {signal.Signals(number).name}\\n".encode())  # print may be in the middle of a line
    sys.exit(9)
signal.signal(signal.SIGTERM, end)
signal.signal(signal.SIGINT, end)
print("waiting", flush=True)
time.sleep(600)
"""


class Lock:
    """``trade lock WORDS -- python SOURCE``, talked to."""

    def __init__(self, source: str, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "trade_gateway", "lock", *words, "--", sys.executable, "-c", source],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline().strip()
        if not line:
            pytest.fail(f"it ended with {self.process.wait(PATIENCE_S)}: {self.end()[1]}")
        return line

    def tell(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()

    def close(self) -> None:
        """Tell it to end, and its program with it."""
        if self.process.poll() is None:
            self.process.terminate()
        if self.process.stdout is not None and not self.process.stdout.closed:
            self.end()

    def end(self) -> tuple[str, str]:
        """Let its input end; the rest of its output, and its complaints."""
        return self.process.communicate(timeout=PATIENCE_S)


@pytest.fixture
def locked(rosie_up):
    """Brings rosie up and holds locks around programs; ends them."""
    rosie_up()
    started: list[Lock] = []

    def start(source: str, *words: str) -> Lock:
        started.append(Lock(source, *words))
        return started[-1]

    yield start
    for lock in started:
        lock.close()


@pytest.fixture
def no_container_there() -> str:
    """An endpoint without a listener."""
    return free_endpoint()


def move(joint: str = "pan") -> float:
    return trade.find(where(name="move_to", group=f"rosie.neck.{joint}"), wait_s=30).with_(deadline_s=30)(0.05)


def test_a_program_that_holds_a_lock_moves_and_other_callers_are_refused(locked, trade_command: Command) -> None:
    program = locked(MOVES, "rosie.neck.pan", "--purpose", "look around")
    assert program.line() == "moved 0.1"
    with pytest.raises(LockedByOther, match="look around"):
        move()
    assert move("tilt") == pytest.approx(0.05, abs=0.02)
    [reported] = json.loads(trade_command("locks", "--json").stdout)
    assert (reported["resources"], reported["purpose"]) == (["rosie.neck.pan"], "look around")
    assert "look around" in trade_command("locks").stdout
    program.end()
    assert program.process.returncode == 7
    assert "nothing is locked" in trade_command("locks").stdout
    assert move() == pytest.approx(0.05, abs=0.02)


def test_a_lock_by_names_is_of_all_of_them(locked, trade_command: Command) -> None:
    program = locked(WAITS, "--name", "move_*", "--name", "enable")
    assert program.line() == "waiting"
    [reported] = json.loads(trade_command("locks", "--json").stdout)
    assert reported["resources"] == ["rosie.neck.pan", "rosie.neck.tilt"]
    assert reported["purpose"].startswith(sys.executable)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_passed_on_and_the_exit_code_comes_back(locked, trade_command: Command, number: int) -> None:
    program = locked(WAITS, "rosie.head")
    assert program.line() == "waiting"
    program.process.send_signal(number)
    assert program.line() == f"got {signal.Signals(number).name}"
    program.end()
    assert program.process.returncode == 9
    assert json.loads(trade_command("locks", "--json").stdout) == []


def test_breaking_a_lock_ends_the_program_and_says_why(locked, trade_command: Command) -> None:
    program = locked(WAITS, "rosie.neck.pan")
    assert program.line() == "waiting"
    broken = trade_command("unlock", "rosie.neck", "--break", "my turn")
    assert "rosie.neck.pan" in broken.stdout
    assert program.line() == "got SIGTERM"
    _, complaints = program.end()
    assert complaints.startswith("the lock of rosie.neck.pan is lost: broken by ")
    assert "my turn" in complaints
    assert len(complaints.splitlines()) == 1
    assert program.process.returncode == 1
    assert "nothing of rosie.neck was locked" in trade_command("unlock", "rosie.neck", "--break", "again").stdout


def test_once_the_command_line_is_killed_its_program_is_refused(locked) -> None:
    program = locked(MOVES, "rosie.neck.pan")
    assert program.line() == "moved 0.1"
    program.process.kill()
    program.process.wait(PATIENCE_S)
    wait_until(lambda: not trade.locks(), "its lock fell")
    program.tell("0.2")
    assert program.line() == "LockLost"
    assert move() == pytest.approx(0.05, abs=0.02)


def test_a_lock_that_cannot_be_had_runs_nothing(locked, trade_command: Command, tmp_path: Path) -> None:
    program = locked(WAITS, "rosie.head")
    assert program.line() == "waiting"
    ran = tmp_path / "ran"
    refused = trade_command("lock", "rosie.neck.pan", "--wait", "0", "--", "touch", ran)
    assert refused.returncode == 1
    assert refused.stderr.startswith("LockedByOther: rosie.neck.pan is locked by")
    assert not ran.exists()
    nothing = trade_command("lock", "rosie.*", "--", "/no/such/program")
    assert (nothing.returncode, nothing.stderr[:10]) == (2, "UsageError")
    program.close()
    nothing = trade_command("lock", "rosie.head", "--", "/no/such/program")
    assert nothing.returncode == 2
    assert nothing.stderr.startswith("UsageError: /no/such/program: cannot be run: No such file")


@pytest.mark.parametrize(
    ("words", "code", "complaint"),
    [
        (["lock", "rosie.head"], 2, "UsageError: trade lock: say what to run"),
        (["lock", "--", "true"], 2, "UsageError: trade lock: say what to lock"),
        (["lock", "nowhere", "--wait", "0", "--", "true"], 3, "NoSuchService: no service matches group='nowhere'"),
        (["lock", "a b", "--", "true"], 2, "UsageError: lock a b:"),
        (["estop", "abc"], 2, "UsageError: trade estop: ids are for clearing"),
        (["estop", "--clear", "--limit", "0.2"], 1, "NoContainerFound: no other container was found in system "),
        (["estop", "--clear", "abc", "--limit", "0.2"], 1, "NoContainerFound: no other container was found in system "),
    ],
)
def test_wrong_arguments_are_answered_in_one_line(
    trade_command: Command, words: list[str], code: int, complaint: str
) -> None:
    said = trade_command(*words)
    assert said.returncode == code
    assert said.stderr.startswith(complaint)
    assert len(said.stderr.splitlines()) == 1


@pytest.mark.parametrize("words", [["services"], ["containers"], ["locks"], ["resume", "rosie"], ["faults"]], ids=str)
def test_a_listing_without_containers_is_empty_and_names_the_silent_endpoint(
    trade_command: Command, no_container_there: str, words: list[str]
) -> None:
    said = trade_command("--connect", no_container_there, *words)
    assert (said.returncode, said.stdout) == (1, "")
    assert said.stderr.startswith("NoContainerFound: no other container was found in system test-")
    assert (
        f"no container answers at {no_container_there} (TRADE_CONNECT): nothing accepts connections there"
        in said.stderr
    )


def test_a_call_without_containers_names_the_silent_endpoint(trade_command: Command, no_container_there: str) -> None:
    said = trade_command("--connect", no_container_there, "call", "rosie.head.move_to", "0.1", "--wait", "0.1")
    assert said.returncode == 3
    assert said.stderr.startswith("NoSuchService: no service matches")
    assert f"no container answers at {no_container_there} (TRADE_CONNECT)" in said.stderr
    assert "TRADE_SYSTEM" not in said.stderr


def test_a_group_that_is_not_there_is_guessed(rosie_up: Callable[[], Rosie], trade_command: Command) -> None:
    rosie_up()
    for words in (["resume", "rosie.nekc"], ["unlock", "rosie.nekc", "--break", "it hangs"]):
        said = trade_command(*words)
        assert said.returncode == 3
        assert "Did you mean rosie.neck" in said.stderr


def test_a_link_without_containers_is_reported_as_a_possible_other_system(
    trade_command: Command, start_container: Callable[..., Container]
) -> None:
    door = start_container("door", listen=[free_endpoint()])
    said = trade_command("--system", "hoem", "--connect", door.settings.listen[0], "containers")
    assert said.returncode == 1
    assert "or is the system there another one than hoem?" in said.stderr


def test_resume_of_nothing_is_of_no_such_service(trade_command: Command) -> None:
    said = trade_command("resume", "rosie")
    assert said.returncode == 3
    assert said.stderr.startswith("NoSuchService: no service matches group='rosie'")


def test_S09_an_estop_holds_the_robot_until_it_is_cleared(rosie_up, trade_command: Command) -> None:
    rosie = rosie_up()
    stopped = trade_command("estop", "--reason", "smoke", "--json")
    report = json.loads(stopped.stdout)
    assert stopped.returncode == 0, stopped.stderr
    assert [name.rpartition("/")[2] for name in report["confirmed"]] == ["rosie"]
    refused = trade_command("call", "rosie.neck.pan.move_to", "0.1")
    assert refused.returncode == 1
    assert "smoke" in refused.stderr
    rosie.program.signal(signal.SIGTERM)
    rosie.program.wait()
    assert rosie_up().ready["estops"] == [report["id"]]  # a restart changes nothing
    with pytest.raises(Stopped, match="smoke"):
        move()
    still = trade_command("resume", "rosie.neck")
    assert (still.returncode, "may move" in still.stdout) == (1, False)
    assert f"e-stop {report['id']} is open: smoke" in still.stdout
    cleared = trade_command("estop", "--clear")
    assert (cleared.returncode, "cleared:" in cleared.stdout) == (0, True)
    assert "nothing moves by itself" in cleared.stdout
    assert "trade resume GROUP" in cleared.stdout
    assert move() == pytest.approx(0.05, abs=0.02)
    assert "no e-stop is open" in trade_command("estop", "--clear").stdout
    unknown = trade_command("estop", "--clear", "abc")
    assert (unknown.returncode, "NoSuchEstop: there is no open e-stop abc" in unknown.stderr) == (3, True)


def test_a_stopped_group_is_resumed_by_the_one_command_that_its_refusal_names(
    rosie_up: Callable[[], Rosie], trade_command: Command
) -> None:
    rosie = rosie_up()
    assert trade_command("call", "rosie.head.move_to", "[0.05, 0.05]").returncode == 0
    moved = events(read_log(rosie.log), "motion_started")
    assert trade_command("stop", "rosie.head").returncode == 0
    refused = trade_command("call", "rosie.head.move_to", "[0.1, 0.1]").stderr
    words = re.search(r"`trade (resume rosie\.neck\.pan rosie\.neck\.tilt)`", refused)
    assert words is not None, refused
    unknown = trade_command("resume", "rosie.neck.pan", "rosie.neck.roll")
    assert (unknown.returncode, "no service matches group='rosie.neck.roll'" in unknown.stderr) == (3, True)
    assert "rosie.neck.pan was stopped" in trade_command("call", "rosie.head.move_to", "[0.1, 0.1]").stderr
    assert events(read_log(rosie.log), "motion_started") == moved
    resumed = trade_command(*words[1].split())
    assert resumed.stdout == "may move again: rosie.neck.pan, rosie.neck.tilt\n"
    assert trade_command("call", "rosie.head.move_to", "[0.1, 0.1]").returncode == 0


def test_S09_a_robot_that_comes_up_with_one_open_says_so_and_how_it_is_cleared(
    run: Callable[..., Program], start_container: Callable[..., Container]
) -> None:
    opened = start_container("other").estop("smoke", limit_s=0.2)
    up = run("-m", "trade_gateway", "up", ROSIES_HEAD, "--sim")
    while "Ctrl-C leaves" not in up.line():
        pass
    assert up.line() == f"e-stop {opened.id} is open: smoke; nothing moves before it is cleared\n"
    assert up.line() == f"when it is safe: trade estop --clear {opened.id}\n"


def test_S09_an_estop_clear_without_containers_reports_the_estop_state_as_unknown(trade_command: Command) -> None:
    said = trade_command("estop", "--clear", "--limit", "0.2", "--json")
    assert (said.returncode, said.stdout) == (1, "")
    assert "so it is unknown whether an e-stop is open; none was cleared" in said.stderr


def test_S09_an_estop_clear_without_containers_names_the_silent_endpoint(
    trade_command: Command, no_container_there: str
) -> None:
    said = trade_command("--connect", no_container_there, "estop", "--clear", "--limit", "0.2")
    assert (said.returncode, said.stdout) == (1, "")
    assert (
        f"no container answers at {no_container_there} (TRADE_CONNECT): nothing accepts connections there"
        in said.stderr
    )


def test_S09_a_container_that_does_not_answer_may_have_an_estop_open(rosie_up, trade_command: Command) -> None:
    rosie = rosie_up()
    rosie.program.signal(signal.SIGSTOP)
    try:
        said = trade_command("estop", "--clear", "--limit", "0.5")
    finally:
        rosie.program.signal(signal.SIGCONT)
    assert (said.returncode, said.stdout) == (1, "")
    may_seem_gone = "no other container was found"
    assert re.search(f"rosie did not answer; .*it is unknown|{may_seem_gone}", said.stderr)


def test_S09_an_estop_reaches_the_containers_found_and_names_the_silent_endpoint(
    rosie_up, trade_command: Command, start_container: Callable[..., Container], no_container_there: str
) -> None:
    door = start_container("door", listen=[free_endpoint()])
    rosie_up()
    both = ["--connect", door.settings.listen[0], "--connect", no_container_there]
    said = trade_command(*both, "estop", "--limit", "2")
    assert said.returncode == 1
    assert re.search("stopped: .*rosie", said.stdout)
    assert f"no container answers at {no_container_there}" in said.stderr
    assert "containers there were not stopped" in said.stderr
    said = trade_command(*both, "estop", "--clear", "--limit", "2")
    assert said.returncode == 1
    assert "cleared: " in said.stdout
    assert f"no container answers at {no_container_there}" in said.stderr
    assert "stays open; clear it again when they answer" in said.stderr
    assert move() == pytest.approx(0.05, abs=0.02)


def test_S09_an_estop_that_misses_a_container_or_finds_none_fails(rosie_up, trade_command: Command) -> None:
    stopped = trade_command("estop", "--limit", "0.2")
    assert stopped.returncode == 1
    assert "no container was found" in stopped.stdout
    assert "NOT RECEIVED by any known container: use the switch that cuts the power" in stopped.stdout
    assert "is open" not in stopped.stdout
    rosie = rosie_up()
    rosie.program.signal(signal.SIGSTOP)
    try:
        missed = trade_command("estop", "--limit", "0.5")
    finally:
        rosie.program.signal(signal.SIGCONT)
    assert missed.returncode == 1


def test_S08_a_device_stopped_by_another_client_moves_again_after_resume(
    rosie_up, trade_command: Command, start_container: Callable[..., Container]
) -> None:
    rosie_up()
    move()
    start_container("other").find(where(name="stop", group="rosie.neck.pan"), wait_s=30)()
    with pytest.raises(Stopped):
        move()
    assert "may move again: rosie.neck.pan" in trade_command("resume", "rosie.neck.pan").stdout
    assert move() == pytest.approx(0.05, abs=0.02)
    assert "nothing of rosie.neck was held" in trade_command("resume", "rosie.neck").stdout
