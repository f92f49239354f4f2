"""``trade hub`` in a process of its own: what it carries, and what happens to motion when it is killed."""

import json
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

import trade
from tests.support.waiting import wait_until
from tests.system.conftest import ROSIES_HEAD, Bench, Program
from tests.system.networks import Member, Networks
from tests.system.test_bridges import all_work_together, up
from tests.system.test_deadman import HALFWAY_RAD, moving_client
from trade import where
from trade.errors import Stopped

Run = Callable[..., Program]
Command = Callable[..., "subprocess.CompletedProcess[str]"]
TILT = where(name="move_to", group="rosie.neck.tilt")


def begun(run: Run) -> Program:
    hub = run("-m", "trade_gateway", "hub", "--json")
    assert hub.json()["ready"]
    return hub


def test_S05_if_the_hub_is_killed_a_motion_ends_and_an_estop_arrives_without_it(
    run: Run, benches: Callable[..., Bench], trade_command: Command
) -> None:
    hub = begun(run)
    bench = benches(ROSIES_HEAD)
    client = moving_client(bench, run, "call")
    tilt = trade.find(TILT, wait_s=30).with_(deadline_s=30)
    killed_at = time.monotonic()
    hub.signal(signal.SIGKILL)
    bench.stopped_short(killed_at, HALFWAY_RAD)
    assert client.wait() != 0
    wait_until(lambda: len(trade.containers()) == 1)

    said = trade_command("stop", "rosie.neck")
    assert (said.returncode, "stopped: rosie.neck.pan.stop" in said.stdout) == (0, True), said
    given = trade_command("estop", "--reason", "smoke", "--json")
    report = json.loads(given.stdout)
    assert [name for name in report["confirmed"] if "rosie" in name or "head" in name], given
    hub.wait()
    begun(run)
    wait_until(lambda: len(trade.containers()) == 3, "all see each other again")
    wait_until(lambda: trade.services(TILT), "they know each other's services, which come after the containers")
    with pytest.raises(Stopped):
        tilt(0.1)
    assert trade_command("estop", "--clear").returncode == 0
    trade.resume(where(group="rosie"))
    tilt(0.1)
    assert bench.rests("neck.tilt", killed_at)


def test_attached_containers_work_together_with_those_of_other_hosts(
    networks: Networks, system: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    networks.lay("net", robot="10.231.1.1", laptop="10.231.1.2")
    with ExitStack() as stack:

        def member(host: str, name: str, address: str = "", hub: str = "auto") -> Member:
            monkeypatch.setenv("TRADE_HUB", hub)
            made = Member(networks.host(host), name, address, tmp_path)
            stack.callback(made.close)
            return made

        hub = up(member("robot", "hub", hub="serve"))
        attached = [up(member("robot", f"a{number}")) for number in range(2)]
        listens = up(member("robot", "listens", "10.231.1.1:7450"))
        far = up(member("laptop", "far", "10.231.1.2:0"), "tcp/10.231.1.1:7450")
        everyone = [hub, *attached, listens, far]
        all_work_together(everyone)
        assert [len(each.ask("linked", "1")) for each in attached] == [1, 1]
        late = up(member("robot", "late"))
        all_work_together([*everyone, late])
        far.kill()
        all_work_together([hub, *attached, listens, late])
