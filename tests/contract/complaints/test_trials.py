"""What people who tried this project complained of: placed objects, observers, recordings, refusals and their words."""

import io
import json
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import pytest

import trade
from tests.contract.complaints import trial_mutants as mutants
from tests.contract.complaints.bodies import Body, outcome
from tests.contract.complaints.table import complaint
from tests.unit.gateway.test_recorded_locks import recording_of_the_head
from tests.unit.ros.arms import FakeJoints
from trade import HookEvent, service, where
from trade.testing import MemorySystem, memory_system
from trade_drivers import Motor
from trade_gateway.cli.services._call import parse_arguments
from trade_gateway.cli.services._services import describe
from trade_gateway.clients._schemas import service_view
from trade_gateway.recording._channels import LOCKS
from trade_gateway.recording._reader import entries
from trade_gateway.terminal._output import say_error

pytestmark = pytest.mark.virtual_time

HEAD = "rosie.head"


class Watcher:
    """An object that searches services as a program does."""

    @service(effect="read")
    def sees(self) -> list[str]:
        return sorted(info.name for info in trade.containers())


@complaint(("folder", mutants.a_placed_object_starts_a_container_of_its_own, "it is in a system of its own"))
def test_a_placed_object_finds_nothing(_: Path) -> None:
    with memory_system() as system:
        host, asker = system.container("host", instantiable=[f"{__name__}:*"]), system.container("asker")
        system.settle()
        [sees] = host.system.instantiate(f"{__name__}:Watcher")
        said: list[Any] = []
        assert (outcome(lambda: said.append(sees())), said) == ("", [["asker", "host"]]), "it is in a system of its own"
        assert {info.name for info in asker.containers()} == {"host", "asker"}


class Planner:
    @service
    def plan(self, goal: str) -> str:
        return goal


class Observer:
    def __init__(self, system: MemorySystem) -> None:
        self.saw: list[str] = []
        system.container("eye").register(self, "eye")
        system.container("desk").find(where(name="see", container="eye"), wait_s=5)
        system.settle()

    @service(effect="read")
    def see(self, called: HookEvent) -> None:
        self.saw.append(called.args["goal"])


@complaint(("folder", mutants.a_callee_is_looked_up_once, "the observer sees nothing after its restart"))
def test_an_observer_sees_nothing_after_its_restart(_: Path) -> None:
    with memory_system() as system:
        system.container("desk").register(Planner(), "desk")
        first = Observer(system)
        plan = system.container("chief").find("desk.plan", wait_s=5)
        system.container("chief").after_service("desk.plan", call=where(name="see"))
        plan("one")
        system.container("eye").close()
        system.settle()
        plan("unseen")
        second = Observer(system)
        plan("two")
        assert first.saw == ["one"]
        assert second.saw == ["two"], "the observer sees nothing after its restart"


@complaint(("folder", mutants.the_locks_of_a_group_have_its_name, "the recording has no lock"))
def test_a_recording_of_a_group_has_no_locks(folder: Path) -> None:
    path = recording_of_the_head(folder)
    found = [json.loads(entry.data)["locks"] for entry in entries(path) if entry.topic == LOCKS.topic]
    held = {lock["purpose"] for locks in found for lock in locks}
    assert held, "the recording has no lock"
    assert held == {"nod", "shake"}  # and not that of the tail


@complaint(
    ("dynamixel", mutants.a_simulated_servo_is_fresh_from_the_factory, "the simulator is another servo than the file"),
    ("feetech", mutants.a_simulated_servo_is_fresh_from_the_factory, "the simulator is another servo than the file"),
)
def test_a_calibrated_robot_cannot_be_simulated(body: Body) -> None:
    body.rig.configure(("id = 1\n", "id = 1\nhoming_counts = -120\n"))
    attached: list[Motor] = []
    said = outcome(lambda: attached.append(body.motor()))
    assert said == "", f"the simulator is another servo than the file: {said}"
    [motor] = attached
    body.shift_its_zero(0)
    assert "is 0, but -120 in the robot file" in outcome(motor.enable)


@complaint(("folder", mutants.a_refusal_names_one_joint, "one joint of two"))
def test_stopped_joints_are_named_one_after_the_other(_: Path) -> None:
    with memory_system() as system:
        joints = FakeJoints("rosie.pan", "rosie.tilt")
        system.container("robot").register(joints, HEAD)
        planner = system.container("planner")
        move = planner.find(f"{HEAD}.move_to", wait_s=5)
        with planner.lock(HEAD):  # a stop by another client than the owner holds
            system.container("operator").stop(HEAD)
            refused = outcome(lambda: move([0.1, 0.1]))
        assert refused.startswith("Stopped: ")
        assert "`trade resume rosie.pan rosie.tilt`" in refused, f"one joint of two: {refused}"
        planner.resume(HEAD)
        assert outcome(lambda: move([0.1, 0.1])) == ""


class Arm:
    @service
    def move_to_pose(self, pose: str, speed_m_s: float = 0.1) -> None: ...


@complaint(("folder", mutants.every_word_is_json, "a text needs quotes of its own"))
def test_a_text_needs_two_kinds_of_quotes(_: Path) -> None:
    with memory_system() as system:
        info = system.container("me").register(Arm())[0].record.info
    said: list[Any] = []
    outcome(lambda: said.append(parse_arguments(["home"], info)))
    assert said == [(["home"], {})], "a text needs quotes of its own"
    assert "speed_m_s takes a number" in outcome(lambda: parse_arguments(["speed_m_s=fast"], info))


class Careless:
    @service
    def fail(self) -> None:
        raise RuntimeError("the gripper is jammed")


@complaint(("folder", mutants.an_error_has_all_its_lines, "lines long"))
def test_an_error_fills_the_screen(_: Path) -> None:
    with memory_system() as system:
        system.container("left").register(Careless(), "hand")
        fail = system.container("me").find("hand.fail", wait_s=5)
        with pytest.raises(RuntimeError) as failed:
            fail()
    with redirect_stderr(io.StringIO()) as shown:
        say_error(failed.value, rest="--traceback shows the whole traceback")
    lines = shown.getvalue().splitlines()
    assert lines[0] == "RuntimeError: the gripper is jammed"
    assert len(lines) <= 4, f"the error is {len(lines)} lines long"
    assert 'raise RuntimeError("the gripper is jammed")' in lines[2]


class Cup:
    @service(achieves=["empty(cup)"])
    def drink(self) -> None: ...


@complaint(("folder", mutants.a_description_has_what_a_caller_types, "its post-condition is left out"))
def test_a_description_leaves_post_conditions_out(_: Path) -> None:
    with memory_system() as system:
        [drink] = system.container("me").register(Cup(), "cup")
        shown = [describe(drink)["achieves"], service_view(drink, allowed=True).achieves]
        found = [one.label for one in system.container("me").services(where(achieves="empty(cup)"))]
    assert shown == [("empty(cup)",)] * 2, "its post-condition is left out"
    assert found == ["cup.drink"]
