"""Children of a gateway: up in order, up again after whatever ends or hangs them, given up when that is no use."""

import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

import trade
from tests.support.certificates import Papers
from tests.support.http_clients import Client
from tests.support.waiting import wait_until
from tests.system.conftest import ROSIES_HEAD, Program, at_ports
from tests.system.supervised import COUNTER, MODULE, Keeping, call
from trade import Container, where
from trade.errors import ConfigurationError
from trade_gateway.http import add_token
from trade_hil_sim import Absent, SimProcess, events, motion_writes, writes


def test_children_start_in_order_and_end_in_the_other_one(keeping: Callable[..., Keeping]) -> None:
    kept = keeping(f'[container.b]\nproviders = []\nafter = ["a"]\n[container.a]\n{COUNTER}')
    kept.become("b", "up")
    assert call("count") == 1
    kept.supervisor.close()
    assert [text.split()[0] for text in kept.texts()] == ["a", "b", "b", "a"]
    assert kept.texts()[2:] == ["b ended (exit code 0)", "a ended (exit code 0)"]


def test_P70_a_child_that_is_killed_is_back_with_its_state(keeping: Callable[..., Keeping]) -> None:
    kept = keeping(f"[container.a]\nsave_every_s = 1\n{COUNTER}")
    first = kept.become("a", "up")
    assert call("count") == 1
    assert call("count") == 2
    saved = kept.supervisor._store
    wait_until(lambda: saved.load("a") == {"tiny:Counter hall": {"total": 2}}, "it is saved")
    os.kill(first.pid, signal.SIGKILL)
    again = kept.become("a", "up", restarts=1)
    assert again.pid != first.pid
    assert call("shown") == 2
    assert kept.texts()[1:] == ["a crashed (signal 9); back in 0.05 s", f"a is back, process {again.pid}"]


def test_a_restarted_child_resumes_from_its_last_reported_save(keeping: Callable[..., Keeping]) -> None:
    kept = keeping(f"[container.a]\nsave_every_s = 1\n{COUNTER}")
    first = kept.become("a", "up")
    call("count")
    counted_at = time.time()
    wait_until(lambda: (kept.child("a") or first).saved_at > counted_at, "it is saved")
    os.kill(first.pid, signal.SIGKILL)
    again = kept.become("a", "up", restarts=1)
    assert call("shown") == 1
    assert again.saved_at > counted_at


def test_a_child_that_hangs_is_killed_and_started_again(keeping: Callable[..., Keeping]) -> None:
    kept = keeping(f"[container.a]\nanswers_within_s = 1\n{COUNTER}", grace_s=0.5)
    hung = kept.become("a", "up")
    os.kill(hung.pid, signal.SIGSTOP)
    kept.become("a", "up", restarts=1)
    assert not psutil.pid_exists(hung.pid)
    assert kept.texts()[1:4] == [
        "a is asked to shut down: it did not answer within 1 s",
        "a does not shut down and is killed",
        "a crashed (signal 9); back in 0.05 s",
    ]


def test_a_child_that_ignores_the_shutdown_request_is_killed(keeping: Callable[..., Keeping]) -> None:
    kept = keeping('[container.a]\nallow = ["tiny:*"]\nproviders = []\n', grace_s=0.5)
    stays = kept.become("a", "up")
    os.kill(stays.pid, signal.SIGSTOP)
    kept.supervisor.close()
    assert not psutil.pid_exists(stays.pid)
    assert kept.texts()[1:] == ["a does not shut down and is killed", "a crashed (signal 9)"]


def test_a_child_that_ignores_sigterm_is_killed_after_its_grace_and_started_again_with_its_state(
    keeping: Callable[..., Keeping],
) -> None:
    kept = keeping('[container.a]\nproviders = [{ class = "tiny:Stays", groups = ["hall"] }]\n', grace_s=0.5)
    stays = kept.become("a", "up")
    call("count")
    call("ignore")
    assert kept.supervisor.restart("a", "anna")
    again = kept.become("a", "up", restarts=1)
    assert not psutil.pid_exists(stays.pid)
    assert call("shown") == 1
    assert kept.texts()[1:] == [
        "a is restarted at the request of anna",
        "a is asked to shut down: it is to start again",
        "a does not shut down and is killed",
        f"a is back, process {again.pid}",
    ]


@pytest.mark.parametrize(
    ("wanted", "why"),
    [
        ('providers = [{ class = "tiny:Dies" }]', "ended (exit code 3)"),
        ('providers = [{ class = "tiny:Missing" }]', "it came up, but: "),
        ('robot = "wrong.toml"', "ended (exit code 1: ConfigurationError: "),
    ],
)
def test_a_child_that_always_fails_is_given_up_with_its_reason_until_its_file_changes(
    keeping: Callable[..., Keeping], wanted: str, why: str, tmp_path: Path
) -> None:
    head = Path(ROSIES_HEAD).read_text()
    (tmp_path / "wrong.toml").write_text(re.sub(r'port = ".*"', 'port = "/dev/null"', head))  # it is no serial port
    kept = keeping(f"[container.a]\nrestarts = 2\n{wanted}\n")
    given_up = kept.become("a", "given up")
    assert (given_up.restarts, given_up.pid) == (2, 0)
    assert why in given_up.why
    assert kept.texts()[-1].startswith("a ended 3 times in 300 s and is given up; the last time it ")
    assert sum("back in" in text for text in kept.texts()) == 2
    kept.set_children(f"[container.a]\nrestarts = 2\n{COUNTER}")
    kept.become("a", "up")
    assert call("count") == 1


def test_a_robot_whose_servos_get_power_later_than_the_computer_comes_up_with_them(
    keeping: Callable[..., Keeping], sim: SimProcess, tmp_path: Path
) -> None:
    sim.control.do(Absent(ids=(1,)))
    kept = keeping(f'[container.a]\nrestarts = 1\nrobot = "{at_ports(ROSIES_HEAD, sim, tmp_path)}"\n')
    waiting = kept.become("a", "waiting", restarts=3)  # two crashes would have ended it
    assert waiting.absent
    assert "ended (exit code 75: DeviceAbsent: " in waiting.why
    assert "no device answers to id 1" in waiting.why
    sim.control.do(Absent(ids=(1,), on=False))
    back = kept.become("a", "up")
    assert not back.absent
    told = kept.texts()
    assert [text for text in told if "waits for its device" in text] == told[:1]  # once, however long it takes
    assert not motion_writes(sim.entries())


def test_a_child_that_leaks_is_saved_and_started_again(keeping: Callable[..., Keeping]) -> None:
    kept = keeping(
        "[container.a]\nmax_rss_mb = 400\n"
        'providers = [{ class = "tiny:Grows", groups = ["hall"] }, { class = "tiny:Counter", groups = ["hall"] }]\n'
    )
    kept.become("a", "up")
    call("count")
    assert 0 < kept.supervisor.children()[0].rss_mb < 400
    call("grow", 500)
    kept.become("a", "up", restarts=1)
    assert call("shown") == 1
    assert "MB of memory" in kept.texts()[1]


def test_one_that_is_never_restarted_is_not(keeping: Callable[..., Keeping]) -> None:
    kept = keeping('[container.a]\nrestart = "never"\nproviders = []\n')
    os.kill(kept.become("a", "up").pid, signal.SIGKILL)
    assert kept.become("a", "stopped").restarts == 0
    assert kept.texts()[-1] == "a crashed (signal 9)"


def test_only_what_is_started_otherwise_than_before_starts_again(keeping: Callable[..., Keeping]) -> None:
    others = "[container.b]\nproviders = []\n[container.c]\nproviders = []\n"
    kept = keeping(f"[container.a]\n{COUNTER}{others}")
    before = {name: kept.become(name, "up").pid for name in "abc"}
    call("count")
    kept.set_children(
        f"[container.a]\n{COUNTER}allow = ['tiny:*']\n[container.b]\nproviders = []\nrestarts = 1\n"
        f"[container.d]\n{COUNTER}"
    )
    kept.become("a", "up", restarts=1)
    kept.become("d", "up")
    wait_until(lambda: kept.child("c") is None)
    after = {info.name: info.pid for info in kept.supervisor.children()}
    assert after["b"] == before["b"]
    assert after["a"] != before["a"]
    assert trade.find(where(name="shown", container="a"), wait_s=30)() == 1


@pytest.fixture
def sim() -> Iterator[SimProcess]:
    with SimProcess(ROSIES_HEAD) as running:
        yield running


def test_S20_a_second_supervisor_of_one_robot_is_refused_and_gives_up_with_the_reason(
    keeping: Callable[..., Keeping], sim: SimProcess, tmp_path: Path
) -> None:
    robot = at_ports(ROSIES_HEAD, sim, tmp_path)
    kept = keeping(f'[container.one]\nrobot = "{robot}"\n')
    first = kept.become("one", "up")
    torn = keeping(f'[container.two]\nrobot = "{robot}"\nrestarts = 1\n')
    refused = torn.become("two", "given up")
    assert "ended (exit code 1: ConfigurationError: " in refused.why
    assert any(port in refused.why for port in sim.ports.values())
    assert torn.news.qsize() == 2  # it was tried twice, and no more
    assert kept.become("one", "up").pid == first.pid


class GatewayProcess:
    """``trade gateway`` with children."""

    def __init__(self, run: Callable[..., Program], file: Path, text: str, system: str) -> None:
        self.file = file
        self._system = system
        (file.parent / "tiny.py").write_text(MODULE)
        self.write(text)
        self.program = run("-m", "trade_gateway", "gateway", file, "--json")
        self.ready = self.program.json()

    def write(self, text: str) -> None:
        self.file.write_text(f'system = "{self._system}"\nname = "door"\n{text}')

    def until(self, state: str, child: str = "a") -> dict[str, Any]:
        return self.program.wait_for(lambda said: (said.get("child"), said.get("state")) == (child, state))


@pytest.fixture
def start_gateway(run: Callable[..., Program], tmp_path: Path, system: str) -> Callable[[str], GatewayProcess]:
    return lambda text: GatewayProcess(run, tmp_path / "gateway.toml", text, system)


def children() -> list[Any]:
    return trade.find(where(name="children"), wait_s=30)()


def test_a_gateway_lists_its_children_and_restarts_one_on_request(
    start_gateway: Callable[[str], GatewayProcess],
) -> None:
    there = start_gateway(f"[container.a]\n{COUNTER}")
    there.until("up")
    [info] = children()
    assert (info.name, info.state, info.restarts, info.pid > 0, info.rss_mb > 1) == ("a", "up", 0, True, True)
    call("count")
    restart = trade.find(where(name="restart_child"))
    with pytest.raises(ConfigurationError, match="no child 'b'; there is a"):
        restart("b")
    restart("a")
    there.until("up")
    assert call("shown") == 1
    [again] = children()
    assert (again.restarts, again.pid != info.pid) == (1, True)


def test_children_end_with_their_gateway_however_that_ends(start_gateway: Callable[[str], GatewayProcess]) -> None:
    there = start_gateway(f'[container.a]\n{COUNTER}[container.head]\nrobot = "{ROSIES_HEAD}"\nsim = true\n')
    there.until("up", "head")
    pids = [info.pid for info in children()]
    there.program.signal(signal.SIGKILL)
    wait_until(lambda: not any(map(psutil.pid_exists, pids)), "they have left")


def test_S19_a_driver_that_loses_its_gateway_stops_what_moves_and_leaves(
    start_gateway: Callable[[str], GatewayProcess], sim: SimProcess, tmp_path: Path
) -> None:
    there = start_gateway(f'[container.head]\nrobot = "{at_ports(ROSIES_HEAD, sim, tmp_path)}"\n')
    there.until("up", "head")
    [info] = children()
    pan = trade.find(where(name="move_to", group="rosie.neck.pan"), wait_s=30)
    pan.with_(deadline_s=120).start(1.0, 0.05)
    wait_until(lambda: events(sim.entries(), "motion_started", device_id=1))
    killed_at = time.monotonic()
    there.program.signal(signal.SIGKILL)
    wait_until(lambda: events(sim.entries(), "at_rest", device_id=1, since=killed_at))
    wait_until(lambda: not psutil.pid_exists(info.pid), "it has left")
    assert writes(sim.entries(), device_id=1, register="goal_position", since=killed_at)
    assert not events(sim.entries(), "watchdog_expired")  # it was ordered to, before anything ran out


def test_S18_a_driver_that_is_started_again_moves_and_enables_nothing(
    start_gateway: Callable[[str], GatewayProcess], sim: SimProcess, tmp_path: Path
) -> None:
    there = start_gateway(f'[container.head]\nrobot = "{at_ports(ROSIES_HEAD, sim, tmp_path)}"\n')
    there.until("up", "head")
    [info] = children()
    killed_at = time.monotonic()
    os.kill(info.pid, signal.SIGKILL)
    there.until("up", "head")
    for register in ("goal_position", "goal_velocity", "torque_enable"):
        assert not writes(sim.entries(), register=register, since=killed_at)


def test_P70_a_stopped_gateway_leaves_no_process_and_restores_its_state_after_a_restart(
    start_gateway: Callable[[str], GatewayProcess],
) -> None:
    there = start_gateway(f"[container.a]\n{COUNTER}")
    there.until("up")
    call("count")
    [info] = children()
    there.program.signal(signal.SIGTERM)
    assert there.program.wait() == 0
    assert not psutil.pid_exists(info.pid)
    start_gateway(f"[container.a]\n{COUNTER}").until("up")
    assert call("shown") == 1


POLICY = """
gateways = ["door"]
[roles.robot]
register = ["hall"]
[roles.chief]
read = ["*"]
call = ["*"]
administer = ["*"]
[identities]
a = ["robot"]
anna = ["chief"]
door = ["chief"]
"""


def test_with_certificates_a_gateway_shows_keeps_and_saves_its_children(
    start_gateway: Callable[[str], GatewayProcess], tmp_path: Path, start_container: Callable[..., Container]
) -> None:
    papers = Papers(tmp_path / "pki")
    (tmp_path / "policy.toml").write_text(POLICY)
    gateway_tls, child_tls, my_tls = papers.of("door", purpose="gateway"), papers.of("a"), papers.of("anna")
    there = start_gateway(
        f'tls = "{gateway_tls}"\npolicy = "policy.toml"\n[container.a]\ntls = "{child_tls}"\n{COUNTER}'
    )
    there.until("up")
    anna = start_container("anna", tls=my_tls, policy=tmp_path / "policy.toml")
    anna.find(where(name="count"), wait_s=30)()
    anna.find(where(name="restart_child"), wait_s=30)("a")
    there.until("up")
    assert anna.find(where(name="shown"), wait_s=30)() == 1
    children = anna.find(where(name="children"))
    wait_until(
        lambda: [(one.name, one.state, one.restarts) for one in children()] == [("a", "up", 1)], "it is up again"
    )


def test_a_wrong_gateway_file_changes_nothing_and_a_corrected_one_takes_effect(
    start_gateway: Callable[[str], GatewayProcess],
) -> None:
    there = start_gateway(f"[container.a]\n{COUNTER}")
    there.until("up")
    [info] = children()
    there.write("[container.a]\nprovidres = []\n")
    wait_until(lambda: "unknown key 'providres'" in "".join(there.program.errors))
    assert [one.pid for one in children()] == [info.pid]
    there.write(f"[container.a]\n{COUNTER}[container.b]\nproviders = []\n")
    there.until("up", "b")
    assert next(one.pid for one in children() if one.name == "a") == info.pid


def test_an_http_gateway_that_is_killed_restarts_at_its_address_with_its_tokens(
    start_gateway: Callable[[str], GatewayProcess], tmp_path: Path
) -> None:
    token = add_token(tmp_path / "tokens.toml", "anna")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"127.0.0.1:{taken.getsockname()[1]}"
    there = start_gateway(
        f"[container.a]\n{COUNTER}"
        f'[container.page]\nafter = ["a"]\nhttp = {{ tokens = "tokens.toml", listen = "{place}" }}\n'
    )
    there.until("up", "page")
    anna = Client(f"http://{place}", token)
    wait_until(lambda: anna.call("hall.count").status == 200, "who comes by the HTTP gateway is heard")
    page = next(info for info in children() if info.name == "page")
    os.kill(page.pid, signal.SIGKILL)
    there.until("up", "page")
    wait_until(lambda: anna.call("hall.shown").status == 200, "it is open again")
