"""A running system is brought to another version of the protocol, one process after the other, and back again."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final
from unittest import mock

import pytest

from tests.support.lock_log import Done, Log, read
from tests.support.policies import policy_text
from tests.support.simulated_robots import at_rest
from tests.support.waiting import wait_until
from tests.system.networks import Member, Networks
from tests.system.siege import Driver
from tests.system.siege_judge import judge
from tests.system.siege_records import Answer, AnyRecord, Fault
from tests.system.sites import GATEWAY, SYSTEM, Site
from trade.protocol.messages import PROTOCOL

NOW, NEXT = PROTOCOL, PROTOCOL + 1
_THROUGH: Final = Path(__file__).with_name("other_version.py")
_BEHAVIOUR: Final = Path(__file__).with_name("behaviour.py")
_HOSTS: Final = {"near": "left", "wide": "left", "later": "left", "far": "right", "further": "right2"}
"""Behaviours, and where they are: the robots are on ``left``."""
_POLICY: Final = policy_text(
    " ".join(["rosie=driver dora=driver chief=chief", *(f"{name}=operator" for name in _HOSTS)]),
    head='gateways = ["door"]\n',
    driver="register=rosie,dora",
    operator="read=* call=rosie,dora lock=rosie,dora",
    chief="includes=operator administer=*",
)
_FAST_RAD_S, _SLOW_RAD_S = 2.0, 0.05
_PATIENCE: Final = "stale_after_s = 1\nwatchdog_s = 1"
"""On a busy host a driver or a simulation gets no time for half a second, whatever the version."""
_FEW: Final = 4
"""Moves that show that a client continues."""
pytestmark = [pytest.mark.timeout(600)]


class Stand:
    """Two simulated robots and their drivers on one host, a gateway on another, behaviours here and beyond it."""

    def __init__(self, networks: Networks, folder: Path) -> None:
        self.records = folder / "records"
        self.records.mkdir()
        self._log = Log(self.records, "faults")
        self.site = Site(networks, folder, _POLICY, private='["rosie", "dora"]')
        (folder / "kept.toml").write_text(_POLICY)
        self.drivers = {robot: Driver(self.site, robot, patience=_PATIENCE) for robot in ("rosie", "dora")}
        self.behaviours: dict[str, Member] = {}
        self._turns = 0

    def behave(self, name: str, version: int, robots: list[str], speed_rad_s: float = _FAST_RAD_S) -> None:
        """Start a behaviour, in the place of an earlier one of that name."""
        if name in self.behaviours:
            self.behaviours.pop(name).close()
        host, self._turns = _HOSTS[name], self._turns + 1
        made = self.site.launched(
            host, f"{name}-{self._turns}", identity=name, script=_BEHAVIOUR, through=self._through(version)
        )
        slot = list(_HOSTS).index(name)
        reported = {"slot": slot, "folder": str(self.records), "robots": robots, "speed_rad_s": speed_rad_s}
        made.tell(json.dumps({**reported, "connect": GATEWAY["private" if host == "left" else "public"]}))
        self.behaviours[name] = made

    def _through(self, version: int) -> list[str]:
        return [str(_THROUGH), str(version)]

    def change_gateway(self, version: int) -> None:
        began = time.monotonic()
        self.site.through = self._through(version)
        self.site.end(signal.SIGTERM)
        self._log.note(Fault(t=began, what="kill gateway", whom="door", until=time.monotonic()))
        self.site.begin()

    def change_driver(self, robot: str, version: int) -> None:
        """End it and let it be started again, of that version."""
        driver = self.drivers[robot]
        wait_until(lambda: driver.running, f"the driver of {robot} runs")
        self._log.note(Fault(t=time.monotonic(), what="kill driver", whom=robot, until=1e12))
        driver.run_from_now_on([*self._through(version), "-m", "trade_gateway"])
        before = driver.pid
        os.kill(driver.pid, signal.SIGTERM)
        wait_until(lambda: driver.pid != before, f"the driver of {robot} is started again")

    def command(self, host: str, version: int, *words: str) -> "subprocess.CompletedProcess[str]":
        """What ``trade WORDS`` of a version says on that host."""
        settings = {
            "TRADE_SYSTEM": SYSTEM,
            "TRADE_TLS": str(self.site.papers.of("chief")),
            "TRADE_POLICY": str(self.site.folder / "kept.toml"),
            "TRADE_CONNECT": GATEWAY["private" if host == "left" else "public"],
            "TRADE_RUNTIME_DIR": str(self.site.folder / "runtime" / host),
        }
        return subprocess.run(
            [
                *("ip", "netns", "exec", self.site.networks.host(host)),
                *(sys.executable, *self._through(version), "-m", "trade_gateway", *words),
            ],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            env={**os.environ, **settings},
        )

    def versions(self, host: str, version: int) -> dict[str, int]:
        """By identity, the version of each container that ``trade containers`` of a version lists there.

        On a busy host one may not have answered yet; then that is said, and it is asked again.
        """
        reported: dict[str, int] = {}

        def all_known() -> bool:
            ended = self.command(host, version, "containers", "--json")
            assert ended.returncode == 0, ended.stderr
            reported.update((info["identity"], info["protocol"]) for info in json.loads(ended.stdout))
            return 0 not in reported.values()

        wait_until(all_known, f"{host} knows the version of each container")
        return reported

    def sees(self, name: str) -> list[str]:
        return self.behaviours[name].ask("sees")

    def continues(self, *names: str) -> None:
        """Each of these continues to move."""
        for name in names:
            self._moves_on(name)

    def _moves_on(self, name: str) -> None:
        behaviour = self.behaviours[name]
        before = behaviour.ask("moved")
        wait_until(lambda: behaviour.ask("moved") >= before + _FEW, f"{name} has moved {_FEW} times")

    def cleared(self, *names: str) -> bool:
        """Whether nothing is open any more, as these see it, once it is cleared by a command of each version."""
        for version in (NOW, NEXT):
            self.command("left", version, "estop", "--clear")
        return all(self.behaviours[name].ask("estops") == [] for name in names)

    def complaints(self, whose: str) -> str:
        return (self.site.folder / f"{whose}.complaints").read_text()

    def moving(self, robot: str) -> bool:
        state = self.drivers[robot].sim.control.state()
        return not all(at_rest(device) for bus in state for device in bus.devices)

    def close(self) -> None:
        for driver in self.drivers.values():
            driver.close()
        self.site.close()
        self._log.close()


@pytest.fixture
def stand(networks: Networks, tmp_path: Path) -> Iterator[Stand]:
    with mock.patch.dict(os.environ, PYTHONPATH=str(_BEHAVIOUR.parents[2])):
        made = Stand(networks, tmp_path)
        try:
            yield made
        finally:
            made.close()


def unwell(stand: Stand, name: str, since: float, until: float) -> list[str]:
    """The unexpected replies that a behaviour got in that time.

    A servo that was silent is left out: on a busy host its simulation gets no time, whatever the version.
    """
    return [
        record.how
        for record in read(stand.records, AnyRecord)
        if isinstance(record, (Answer, Done)) and since < record.t < until
        if record.how not in {"arrived", "given back"} and not record.how.startswith("DeviceSilent")
        for number in [record.number if isinstance(record, Answer) else record.hold]
        if number.startswith(f"{name}-")
    ]


@pytest.mark.parametrize("first", ["gateway", "driver"])
def test_a_system_changes_version_and_back_while_unaffected_parts_keep_running(stand: Stand, first: str) -> None:
    stand.behave("near", NOW, ["dora"])
    stand.behave("wide", NOW, ["rosie", "dora"])
    stand.behave("far", NOW, ["dora"])
    stand.continues("near", "wide", "far")
    for before, after in [(NOW, NEXT), (NEXT, NOW)]:
        began = time.monotonic()
        steps: list[Callable[[], None]] = [
            lambda after=after: stand.change_gateway(after),
            lambda after=after: stand.change_driver("rosie", after),
        ]
        for step in steps if first == "gateway" else reversed(steps):
            step()
            stand.continues("near", "far")
        stand.behave("later", after, ["rosie"])
        stand.continues("later", "near", "far")
        assert (stand.sees("near"), stand.sees("far"), stand.sees("later")) == (["dora"], ["dora"], ["rosie"])
        reported = stand.versions("left", before)
        assert {reported[who] for who in ("door", "rosie", "later")} == {after}
        assert {reported[who] for who in ("dora", "near", "far", "wide")} == {before}
        assert stand.versions("right", after)["dora"] == before
        assert "PROTOCOL" in stand.command("left", before, "containers").stdout
        mixed_until = time.monotonic()  # from then on what near uses goes, too
        assert unwell(stand, "near", began, mixed_until) == []
        stand.change_driver("dora", after)
        stand.behaviours.pop("later").close()
        for name, robots in {"near": ["dora"], "wide": ["rosie", "dora"], "far": ["dora"]}.items():
            stand.behave(name, after, robots)
        stand.continues("near", "wide", "far")
        assert set(stand.versions("right", after).values()) == {after}
    wrong = {name: behaviour.ask("works") for name, behaviour in stand.behaviours.items()}
    assert not any(wrong.values()), wrong
    said = stand.complaints("dora")
    assert said.count(f"rosie speaks protocol version {NEXT}, this one speaks {NOW}") == 1, said
    verdict = judge(
        read(stand.records, AnyRecord), {name: driver.sim.entries() for name, driver in stand.drivers.items()}
    )
    assert not verdict.violations, "\n".join(verdict.violations)
    assert verdict.counts["motion"] > _FEW


@pytest.mark.parametrize("gateway", [NOW, NEXT])
def test_S09_an_e_stop_stops_robots_of_both_versions_through_a_gateway_of_either(stand: Stand, gateway: int) -> None:
    if gateway != NOW:
        stand.change_gateway(gateway)
    stand.change_driver("dora", NEXT)
    stand.behave("far", NOW, ["rosie"], _SLOW_RAD_S)
    stand.behave("further", NEXT, ["dora"], _SLOW_RAD_S)
    for version, other in [(NOW, NEXT), (NEXT, NOW)]:
        for robot in stand.drivers:
            wait_until(lambda robot=robot: stand.moving(robot), f"{robot} moves")
        report = _reported(stand.command("right", version, "estop", "--reason", "smoke", "--json"), 0)
        assert not stand.moving("rosie")
        assert not stand.moving("dora")
        assert {who.partition("/")[0] for who in report["confirmed"]} >= {"rosie", "dora"}
        robots = {"rosie": NOW, "dora": NEXT}
        reported = {who.partition("/")[0]: number for who, number in report["versions"].items()}
        assert {who: reported.get(who, version) for who in robots} == robots
        half = _reported(stand.command("right2", version, "estop", "--clear", "--json"), 1)
        assert {who.partition("/")[0] for who in half["missing"]} >= {who for who in robots if robots[who] == other}
        assert stand.behaviours["far"].ask("estops") == stand.behaviours["further"].ask("estops") == [report["id"]]
        wait_until(lambda: stand.cleared("far", "further"), "nothing is open any more")


def test_S09_an_e_stop_stays_open_in_a_driver_that_goes_to_another_version(stand: Stand) -> None:
    stand.behave("near", NOW, ["rosie"])
    stand.continues("near")
    report = _reported(stand.command("left", NOW, "estop", "--json"), 0)
    stand.behaviours.pop("near").close()
    stand.change_gateway(NEXT)
    for version in (NEXT, NOW, NEXT):  # each has what the one before wrote down
        stand.change_driver("rosie", version)
        wait_until(lambda version=version: stand.versions("left", NEXT).get("rosie") == version, "rosie is up")
        stand.behave("near", version, ["rosie"])
        wait_until(lambda: "rosie" in stand.sees("near"), "rosie is seen")  # and dora, where both are of one version
        assert stand.behaviours["near"].ask("estops") == [report["id"]]
    began = [entry for entry in stand.drivers["rosie"].sim.entries() if entry.name == "motion_started"]
    assert stand.behaviours["near"].ask("moved") == 0
    _reported(stand.command("left", NOW, "estop", "--clear", "--json"), 1)
    wait_until(lambda: stand.cleared("near"), "nothing is open any more")
    stand.continues("near")
    assert len([e for e in stand.drivers["rosie"].sim.entries() if e.name == "motion_started"]) > len(began)


def _reported(ended: "subprocess.CompletedProcess[str]", code: int) -> dict[str, Any]:
    assert ended.returncode == code, f"{ended.stdout}\n{ended.stderr}"
    return json.loads(ended.stdout)
