"""Complaints of other projects about calibration, calls within calls, discovery and access rules."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.contract.complaints import system_mutants as mutants
from tests.contract.complaints.bodies import Body, outcome
from tests.contract.complaints.hosts import Loopback, Wifi
from tests.contract.complaints.table import complaint
from tests.support import waiting
from tests.support.waiting import wait_until
from trade import Container, Handle, Settings, service, where
from trade.testing import memory_system
from trade.transport.memory import MemoryTransport, Network
from trade_gateway.cli import app

pytestmark = pytest.mark.realtime


@complaint(
    ("dynamixel", mutants.the_devices_zero_is_taken_as_it_is, "its zero has moved, and no error says so"),
    ("feetech", mutants.the_devices_zero_is_taken_as_it_is, "its zero has moved, and no error says so"),
)
def test_lost_calibration(body: Body) -> None:
    robot = body.attach()
    motor = robot.motor(body.ways.joint)
    motor.enable()
    motor.relax()
    body.shift_its_zero(200)
    refusal = outcome(motor.enable)
    assert refusal.startswith("DeviceFault"), "its zero has moved, and no error says so"
    assert f"register {body.ways.homing[0]}" in refusal
    robot.close()
    assert outcome(body.attach).startswith("WrongDevice"), "its zero has moved, and no error says so"
    body.shift_its_zero(0)
    assert outcome(lambda: body.motor().enable()) == ""


class Counter:
    """Answers with what another service makes of it, which may call back here."""

    @service(effect="read")
    def relay(self, on: list[Handle]) -> int:
        return 1 + (on[0].with_(deadline_s=waiting.PATIENCE_S)(on[1:]) if on else 0)


@complaint(("folder", mutants.one_thread_serves_all_calls, "OutcomeUnknown"))
def test_a_synchronous_call_inside_a_callback_deadlocks(_: object) -> None:
    with memory_system() as system:
        here, there = system.container("here"), system.container("there")
        for home in (here, there):
            home.register(Counter(), f"counter.{home.name}")
        system.settle()
        first, second = (here.find(where(name="relay", container=name)) for name in ("there", "here"))
        answers: list[int] = []
        asked = first.with_(deadline_s=waiting.PATIENCE_S)
        assert outcome(lambda: answers.append(asked([second, first, second, first]))) == ""
        assert answers == [5]


@pytest.mark.system
@complaint(
    ("wifi", mutants.containers_are_searched_by_multicast, "in vain until the planner reaches the robot"),
    also=("loopback",),
)
def test_discovery_fails_on_vpn_or_wifi(hosts: Loopback | Wifi) -> None:
    wait_until(hosts.reached, "the planner reaches the robot")


POLICY = """
revoked = ["thief"]
[roles.operator]
call = ["rosie"]
[roles.driver]
register = ["*"]
[identities]
planner = ["operator"]
thief = ["operator"]
robot = ["driver"]
"""
GROUPS = ("rosie.neck", "rosie", "rosie_spare", "bob")
ALLOWED = {("planner", "rosie.neck"), ("planner", "rosie")}


@complaint(
    ("folder", mutants.a_rule_covers_whatever_begins_like_it, "a rule over rosie is one over rosie_spare"),
    ("folder", mutants.a_check_has_rules_of_its_own, "trade policy check says otherwise"),
)
def test_access_rule_surprises(folder: Path) -> None:
    runner, policy = CliRunner(), folder / "policy.toml"
    policy.write_text(POLICY)
    with memory_system() as system:
        homes = {name: system.container(name, identity=name) for name in ("robot", "planner", "thief")}
        for group in GROUPS:
            homes["robot"].register(Spare(), group)
        system.settle()
        for home in homes.values():
            home.load_policy(policy)
        for who, group in [(who, group) for who in ("planner", "thief") for group in GROUPS]:
            grant = homes[who].services(where(name="grant", group=group))
            [call] = [one for one in grant if one.label == f"{group}.grant"]
            reported = outcome(call)
            meant = "" if (who, group) in ALLOWED else "AccessDenied"
            assert reported.partition(":")[0] == meant, f"a rule over rosie is one over {group}"
            checked = runner.invoke(app, ["policy", "check", who, "call", group, "--policy", str(policy)])
            verdict, _, rule = checked.stdout.strip().partition(": ")
            assert verdict == ("denied" if reported else "allowed"), "trade policy check says otherwise"
            assert not reported or rule in reported


class Spare:
    """A service that a client may or may not use."""

    @service
    def grant(self) -> bool:
        return True


class Axis:
    @service
    def move_to(self, angle_rad: float) -> float:
        return angle_rad

    @service(effect="stop")
    def stop(self) -> None: ...


@complaint(
    ("folder", mutants.the_default_system_is_named_after_the_host, "a renaming of the host renames the system"),
    ("folder", mutants.estops_of_earlier_names_are_ignored, "an open e-stop of an earlier name is ignored"),
)
def test_a_robot_is_lost_when_its_host_is_renamed(folder: Path) -> None:
    environment = {"TRADE_STATE_DIR": str(folder)}
    with pytest.MonkeyPatch.context() as patch:
        before = Settings.read(container="rosie", environment=environment)
        patch.setattr("socket.gethostname", lambda: "renamed")
        after = Settings.read(container="rosie", environment=environment)
    assert after.system == before.system, "a renaming of the host renames the system"
    note = folder / "tom@oldname" / "estop" / "tom" / "rosie" / "abc.json"
    note.parent.mkdir(parents=True)
    note.write_text('["abc", "anna/desk/e1", "spill", 1.5]')
    with Container(after, transport=MemoryTransport(Network(), "rosie")) as rosie:
        rosie.register(Axis(), "rosie.head")
        refusal = outcome(lambda: rosie.find(where(name="move_to"))(0.1))
        assert refusal.startswith("Stopped"), "an open e-stop of an earlier name is ignored"
        assert rosie.estop_clear(["abc"]).complete
        assert outcome(lambda: rosie.find(where(name="move_to"))(0.1)) == ""
    assert not note.exists()
