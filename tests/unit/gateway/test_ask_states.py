"""``trade ask``: questions about reasons, rights and losses, honest answers, and questions that follow others."""

from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.unit.gateway.asked_system import Arm, World, world
from trade import where
from trade_gateway.language import Dialogue, Memory, NotUnderstood, read_lexicon

pytestmark = pytest.mark.virtual_time

__all__ = ["world"]


def stopped(world: World, group: str, arm: Arm) -> None:
    """Another client stops what moves, so that the stop holds."""
    arm.resources[0].moving = True
    arm.resources[0].movers = ("tester/mover/1",)
    world.memory.container("guard").stop(group, "a person came near")
    arm.resources[0].stop("tester/guard", ["tester/guard/1"], "a person came near")
    arm.resources[0].moving = False


def test_why_something_is_stopped_is_answered_from_stops_e_stops_health_and_locks(world: World) -> None:
    talk, arm = world.talk(), Arm("third", world.calls)
    world.base.register(arm, "dora.arm")
    world.memory.settle()
    assert talk.say("why is dora.arm stopped?").text == (
        "I know of no stop, fault or lock that keeps dora.arm from moving."
    )
    stopped(world, "dora.arm", arm)
    assert "tester/guard stopped third: a person came near; `resume` lets it move" in talk.say("why is it stopped").text
    assert "no stop, fault or lock" in talk.say("and the left arm?").text
    assert talk.say("resume dora.arm").waits == "yes"
    assert talk.say("yes").text == "These may move again: third."
    world.base.set_health(arm, "degraded: hot")
    world.memory.settle()
    assert talk.say("why is dora.arm stopped?").data == ["dora.arm is degraded: hot"]
    other = world.memory.container("other")
    with other.lock("dora.arm", wait_s=20):
        assert "tester/other has locked third" in talk.say("why can't dora.arm move").text
    world.memory.container("guard").estop("smoke")
    world.memory.settle()
    assert "an e-stop is open" in talk.say("why is the left arm stopped?").text


def test_the_audit_names_who_stopped_it_last(start_container, system: str, tmp_path: Path) -> None:
    calls: list[str] = []
    robot = start_container("robot", audit=tmp_path / "audit")
    robot.register(Arm("left", calls), "rosie.left.arm")
    asker = start_container("asker")
    asker.stop("rosie.left.arm")
    talk = Dialogue(asker, read_lexicon(), Memory(), audit=tmp_path / "audit")
    wait_until(lambda: "the audit has a call" in talk.say("why is the left arm stopped").text)
    assert "rosie.left.arm.stop by" in talk.say("why is the left arm stopped").text


def test_a_predicate_is_read_as_one_and_unknown_is_not_none(world: World) -> None:
    talk = world.talk()
    assert talk.say("who can see a mug?").text == "rosie.eyes.check_for can."
    assert talk.say("is there a service that can see the red mug on a table").text == (
        "I do not know of a service that can see the red mug on a table."
    )
    assert talk.say("who can see anything?").data == ["rosie.eyes.check_for"]
    assert talk.say("who can smell a mug?").text == "I do not know of a service that can smell a mug."
    assert talk.say("can anyone open the gripper?").data == []


def test_who_may_move_something_is_answered_from_the_policy_or_is_every_client(world: World, tmp_path: Path) -> None:
    talk = world.talk()
    every = "I know of no policy, so every client of the system may"
    assert talk.say("who may move the head?").text == f"{every}."
    with world.memory.container("other").lock("rosie.head", wait_s=20):
        assert talk.say("may I move the head?").text == f"{every}. Now only tester/other can, under a lock."
    policy = tmp_path / "policy.toml"
    policy.write_text(
        '[roles.operator]\ncall = ["rosie"]\n[roles.viewer]\nread = ["rosie"]\n[roles.robot]\nregister = ["*"]\n'
        '[identities]\nanna = ["operator"]\n"op-*" = ["operator"]\nbob = ["viewer"]\nolga = ["viewer"]\n'
        'tester = ["robot"]\n'
    )
    world.asker.load_policy(policy)
    assert talk.say("who may move the head?").data == ["anna", "op-*"]
    with pytest.raises(NotUnderstood, match="eyes has no service that moves it"):
        talk.say("who may move the eyes?")


def test_what_would_stop_names_containers_services_and_locks(world: World) -> None:
    talk = world.talk()
    with world.memory.container("other").lock("rosie.head", wait_s=20):
        reply = talk.say("What would stop if base died?")
    assert reply.text.startswith("Without container base, these would be gone: container base; 7 services: rosie.eyes")
    assert "a lock: neck of tester/other" in reply.text
    assert reply.data["containers"] == ["base"]
    assert (
        talk.say("what depends on spare").text == "Without container spare, no service would be gone: container spare."
    )
    everything = talk.say(f"what happens if host {world.host} crashes").data
    assert {"base", "rover", "spare"} <= set(everything["containers"])
    with pytest.raises(NotUnderstood, match="I know no container or host 'mars'"):
        talk.say("what would stop if mars died?")


def test_a_question_that_follows_another_repeats_it_with_another_name(world: World) -> None:
    talk = world.talk()
    with world.memory.container("other").lock(where(group="rosie.right.arm"), wait_s=20):
        assert talk.say("Who has the left arm?").text == "Nobody has it: left arm is free."  # plain: Nobody
        assert "tester/other has right" in talk.say("and the right one?").text
        assert talk.say("and the head").text == "Nobody has it: head is free."  # plain: Nobody
    assert talk.say("Where is it?").text == f"head is in container base on host {world.host}."
    with pytest.raises(NotUnderstood, match="I know no group 'wings'"):
        talk.say("and the wings?")


def test_a_follow_up_never_repeats_an_order(world: World) -> None:
    talk = world.talk()
    with pytest.raises(NotUnderstood, match="that repeats a question"):
        talk.say("and the legs?")
    talk.say("stop the left arm")
    done = list(world.calls)
    with pytest.raises(NotUnderstood, match="that repeats a question"):
        talk.say("and the right one?")
    assert world.calls == done == ["left stops"]
