"""Strangers that fill the ports of a driver or a gateway shut no client out of stop and e-stop (S07)."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.certificates import Papers
from tests.support.waiting import wait_until
from tests.system.networks import Member, Networks, ip
from tests.system.sites import GATEWAY, Site

FLOOD = Path(__file__).with_name("stranger_flood.py")
NEWCOMER = Path(__file__).with_name("newcomer.py")
PER_S, IDLE = "1000", "1000"
MANY = [f"10.231.7.{last}" for last in range(10, 210)]
MOST_DESCRIPTORS = 1200
"""Above what a container has anyway: the strangers of both ports, 128 and 256, and what comes until that is noticed."""
pytestmark = [pytest.mark.timeout(300)]


class Flood:
    """Strangers from one host, until it is ended."""

    def __init__(self, namespace: str, targets: str, addresses: str = "-", user: str = "-") -> None:
        inside = ["ip", "netns", "exec", namespace] if namespace else []
        self._process = subprocess.Popen(
            [*inside, sys.executable, str(FLOOD), targets, PER_S, IDLE, addresses, user],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        self.idle: int = json.loads(self._process.stdout.readline())["answer"]["idle"]

    def end(self) -> float:
        """How many came each second."""
        said, _ = self._process.communicate("", timeout=60)
        return json.loads(said)["answer"]["per_s"]


@pytest.fixture
def flood() -> Iterator[Callable[..., Flood]]:
    begun: list[Flood] = []

    def begin(*args: Any, **options: Any) -> Flood:
        begun.append(Flood(*args, **options))
        return begun[-1]

    yield begin
    for one in begun:
        one._process.kill()
        one._process.communicate()


@pytest.fixture
def came(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """What a newcomer says of its stop and its e-stop."""

    def come(namespace: str, environment: dict[str, str], *connect: str) -> dict[str, Any]:
        inside = ["ip", "netns", "exec", namespace] if namespace else []
        said = subprocess.run(
            [*inside, sys.executable, str(NEWCOMER), "rosie", "8", *connect],
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert said.returncode == 0, said.stderr
        with capsys.disabled():
            print(said.stdout)
        return json.loads(said.stdout)

    return come


def check(said: dict[str, Any], *stops: str) -> None:
    """Both reached what there is to stop, for who has a link and for who has none."""
    assert said["line"][0], said
    assert said["stop"][0], said
    assert said["estop"][0], said
    for name in stops:
        assert name in said["line"][2]
        assert name in said["stop"][2]


def descriptors(process: int) -> int:
    return len(list(Path(f"/proc/{process}/fd").iterdir()))


@pytest.mark.parametrize("many", [False, True], ids=["one address", "200 addresses"])
def test_S07_strangers_at_a_drivers_port_shut_no_newcomer_out_of_stops(
    networks: Networks,
    tmp_path: Path,
    system: str,
    flood: Callable[..., Flood],
    came: Callable[..., dict[str, Any]],
    many: bool,
) -> None:
    networks.lay("cable", left="10.231.7.1", right="10.231.7.2")
    for address in MANY if many else ():
        ip("-n", networks.host("right"), "addr", "add", f"{address}/24", "dev", "cable")
    papers = Papers(tmp_path / "pki")
    driver = Member(
        networks.host("left"), "a", "10.231.7.1:7450", tmp_path, tls=papers.of("a", addresses=["10.231.7.1"])
    )
    try:
        driver.ask("start")
        driver.ask("register_joint", "rosie.neck")
        before = descriptors(driver.pid)
        strangers = flood(networks.host("right"), "10.231.7.1:7450,10.231.7.1:8450", ",".join(MANY) if many else "-")
        environment = {
            "TRADE_TLS": str(papers.of("anna")),
            "TRADE_RUNTIME_DIR": str(tmp_path / "right"),
            "TRADE_SYSTEM": f"{system}-0",
        }
        check(came(networks.host("right"), environment, "tls/10.231.7.1:7450"), "rosie.neck.halt")
        assert len(driver.ask("estops")) == 1
        assert descriptors(driver.pid) - before < MOST_DESCRIPTORS
        assert strangers.end() > 100
        wait_until(lambda: descriptors(driver.pid) - before < MOST_DESCRIPTORS // 2)
    finally:
        driver.close()


def test_S07_strangers_at_a_gateways_port_shut_no_newcomer_out_of_stops(
    networks: Networks, tmp_path: Path, flood: Callable[..., Flood], came: Callable[..., dict[str, Any]]
) -> None:
    policy = """
gateways = ["door"]
[roles.driver]
register = ["rosie"]
[roles.operator]
read = ["*"]
[identities]
arm = ["driver"]
anna = ["operator"]
"""
    site = Site(networks, tmp_path, policy, private='["rosie"]')
    try:
        arm = site.member("left", "arm")
        arm.ask("register_joint", "rosie.neck")
        before = descriptors(site.gateway.pid)
        host, port = GATEWAY["public"].removeprefix("tls/").split(":")
        flood(networks.host("right2"), f"{host}:{port},{host}:{int(port) + 1000}")
        environment = {
            "TRADE_TLS": str(site.papers.of("anna")),
            "TRADE_RUNTIME_DIR": str(tmp_path / "right"),
            "TRADE_SYSTEM": "lab-0",
            "TRADE_POLICY": str(site.policy),
        }
        check(came(networks.host("right"), environment, GATEWAY["public"]), "rosie.neck.halt")
        assert len(arm.ask("estops")) == 1
        assert descriptors(site.gateway.pid) - before < MOST_DESCRIPTORS
    finally:
        site.close()


def test_a_gateway_starts_while_strangers_are_at_its_port(
    networks: Networks, tmp_path: Path, flood: Callable[..., Flood], came: Callable[..., dict[str, Any]]
) -> None:
    policy = 'gateways = ["door"]\n[roles.driver]\nregister = ["rosie"]\n[identities]\narm = ["driver"]\n'
    site = Site(networks, tmp_path, policy, private='["rosie"]')
    try:
        arm = site.member("left", "arm")
        arm.ask("register_joint", "rosie.neck")
        host, port = GATEWAY["public"].removeprefix("tls/").split(":")
        flood(networks.host("right2"), f"{host}:{port},{host}:{int(port) + 1000}")
        site.end(signal.SIGKILL)
        site.begin()
        assert site.ready["ready"] is True, site.complaints()
        environment = {
            "TRADE_TLS": str(site.papers.of("anna")),
            "TRADE_RUNTIME_DIR": str(tmp_path / "right"),
            "TRADE_SYSTEM": "lab-0",
            "TRADE_POLICY": str(site.policy),
        }
        check(came(networks.host("right"), environment, GATEWAY["public"]), "rosie.neck.halt")
    finally:
        site.close()


def test_S07_another_user_of_this_host_shuts_no_newcomer_out_of_stops(
    tmp_path: Path,
    system: str,
    flood: Callable[..., Flood],
    came: Callable[..., dict[str, Any]],
    networks: Networks,
) -> None:
    if os.geteuid() != 0:
        pytest.skip("to be another user takes root")
    host = networks.host("alone")
    driver = Member(host, "a", "", tmp_path)
    try:
        endpoint = driver.ask("start")
        driver.ask("register_joint", "rosie.neck")
        before = descriptors(driver.pid)
        flood(host, endpoint.partition("/")[2], user="65534")
        environment = {
            "TRADE_CREDENTIALS": "lab:secret",
            "TRADE_RUNTIME_DIR": str(tmp_path / host),
            "TRADE_SYSTEM": f"{system}-0",
        }
        check(came(host, environment), "rosie.neck.halt")
        assert len(driver.ask("estops")) == 1
        assert descriptors(driver.pid) - before < MOST_DESCRIPTORS
    finally:
        driver.close()
