"""``trade ask``: orders are planned, confirmed and made as ordinary calls, or nothing is done."""

from pathlib import Path

import pytest

from tests.support.policies import policy_text
from tests.unit.gateway.asked_system import Arm, World, world
from tests.unit.gateway.test_ask_sentences import sentences
from trade import service, where
from trade.errors import AccessDenied, LockedByOther, LockLost, NotInstantiable
from trade_gateway.language import Dialogue, NotUnderstood, read_lexicon
from trade_gateway.language import _dialogue as dialogue
from trade_gateway.language._catalogue import REQUESTS

pytestmark = pytest.mark.virtual_time

__all__ = ["world"]

POLICY = policy_text("olga=viewer tester=robot", viewer="read=*", robot="register=*")


def refused(talk: Dialogue, sentence: str) -> str:
    with pytest.raises(NotUnderstood) as error:
        talk.say(sentence)
    return str(error.value)


@pytest.mark.parametrize(
    ("sentence", "shall", "calls"),
    [
        (
            "Turn on discovery",
            "turn on discovery in base, rover, spare",
            ["base set_discovery True", "rover set_discovery True", "spare set_discovery True"],
        ),
        ("turn off discovery on rover", "turn off discovery in rover", ["rover set_discovery False"]),
        ("stop broadcasting on base", "turn off broadcast in base", ["base set_broadcast False"]),
        ("connect to 10.0.0.7 from base", "connect base to tcp/10.0.0.7:7450", ["base connect tcp/10.0.0.7:7450"]),
        ("connect base to tcp/10.0.0.7:51", "connect base to tcp/10.0.0.7:51", ["base connect tcp/10.0.0.7:51"]),
        ("connect base to a.example:99", "connect base to tcp/a.example:99", ["base connect tcp/a.example:99"]),
        ("disconnect base from [::1]", "disconnect base from tcp/[::1]:7450", ["base disconnect tcp/[::1]:7450"]),
        ("disconnect base from rover", "disconnect base from rover", ["base disconnect rover"]),
        ("restart the camera driver", "restart container camera-driver by gateway base", ["restart camera-driver"]),
        (
            "shut down container spare",
            "end container spare, if it is at rest and not locked",
            ["spare terminate_container asked in a dialogue"],
        ),
    ],
)
def test_P58_an_order_says_what_it_would_do_and_is_done_after_a_yes(
    world: World, sentence: str, shall: str, calls: list[str]
) -> None:
    talk = world.talk()
    reply = talk.say(sentence)
    assert (reply.text, reply.waits) == (f"Shall I {shall}? (yes/no)", "yes")
    assert talk.say("no").text == "Nothing was done."
    assert world.calls == []
    talk.say(sentence)
    talk.say("Yes!")
    assert sorted(world.calls) == sorted(calls)


def test_a_yes_counts_once_soon_and_only_for_the_sentence_before(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    talk = world.talk()
    assert "I have asked nothing" in refused(talk, "yes")
    talk.say("turn off discovery")
    talk.say("is everything all right?")
    assert "I have asked nothing" in refused(talk, "yes")
    talk.say("turn off discovery")
    monkeypatch.setattr(dialogue, "_CONFIRM_S", -1.0)
    assert "Say the order again" in refused(talk, "yes")
    assert "I have asked nothing" in refused(talk, "yes")
    assert world.calls == []


def test_an_order_that_comes_with_its_confirmation_is_done_at_once(world: World) -> None:
    assert world.talk().say("turn off discovery on base", confirmed=True).text == "Discovery is off in base."
    assert world.calls == ["base set_discovery False"]


def test_a_service_that_a_phrase_calls_needs_a_confirmation_only_if_it_acts(world: World, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(
        '[[phrase]]\nhear = ["nod {number}"]\ncall = "rosie.head.move"\nargs = ["{number}"]\nsay = "{result}"\n'
        '[[phrase]]\nhear = ["do you see [a] {thing}"]\ncall = "rosie.eyes.check_for"\nargs = ["{thing}"]\n'
        'say = "{result}"\n'
        '[[phrase]]\nhear = ["hush"]\ncall = "rosie.head.stop"\nsay = "{result}"\n'
        '[name]\nneck = "rosie.head"\n'
    )
    talk = world.talk(read_lexicon(tmp_path / "own.toml"))
    assert talk.say("nod 0.5").text == "Shall I call rosie.head.move(0.5)? (yes/no)"
    assert talk.say("do you see a cup").text == "true"
    assert world.calls == []
    talk.say("hush")
    talk.say("nod 0.5")
    talk.say("yes")
    talk.say("stop the neck")
    assert world.calls == ["neck stops", "neck moves 0.5", "neck stops"]


def test_a_name_that_is_unknown_lists_what_exists_and_nothing_is_done(world: World) -> None:
    talk = world.talk()
    assert "I know no container or host 'mars'; there is container base, container rover" in refused(
        talk, "turn on discovery on mars"
    )
    assert "there is rosie, rosie.eyes, rosie.head" in refused(talk, "move the cook to base")
    assert "I do not know the class of 'vision provider'" in refused(talk, "start a vision provider on rover")
    assert "gateways here restart these containers: camera-driver" in refused(talk, "restart base")
    assert "`stop` alone stops everything" in refused(talk, "stop the wings")
    assert "no e-stop is open" in refused(talk, "clear the e-stop")
    assert world.calls == []


def test_a_sentence_with_two_meanings_asks_which_one(world: World) -> None:
    talk = world.talk()
    reply = talk.say("connect to 10.0.0.7")
    assert reply.text == "Which one do you mean: container base, container rover or container spare?"
    assert reply.waits == "choice"
    assert talk.say("rover").text == "Shall I connect rover to tcp/10.0.0.7:7450? (yes/no)"
    assert talk.say("lock the arm").waits == "choice"
    assert "I do not understand" in refused(talk, "the middle one")
    assert talk.say("lock the arm").waits == "choice"
    assert "left" in talk.say("the left one").text
    assert world.calls == []
    talk.close()


def test_a_whole_name_has_one_meaning(world: World) -> None:
    world.base.register(Arm("other neck", world.calls), "dora.rosie.head")
    world.memory.settle()
    talk = world.talk(keeps=False)
    talk.say("stop rosie.head")
    assert world.calls == ["neck stops"]


def test_a_container_with_two_meanings_is_asked_for(world: World) -> None:
    for name in ("left-driver", "right-driver"):
        world.memory.container(name)
    world.memory.settle()
    talk = world.talk()
    assert talk.say("shut down the driver").text == "Which one do you mean: left-driver or right-driver?"
    assert talk.say("left").data == "end container left-driver, if it is at rest and not locked"
    assert world.calls == []
    for number in range(20):
        world.memory.container(f"c{number:02}")
    world.memory.settle()
    assert talk.say("connect to 10.0.0.7").text.endswith("container c08 or 15 more?")


def test_a_stop_with_two_meanings_stops_both_and_needs_no_confirmation(world: World) -> None:
    assert world.talk(keeps=False).say("stop the arms!").text == "stopped: rosie.left.arm.stop, rosie.right.arm.stop."
    assert sorted(world.calls) == ["left stops", "right stops"]


def test_an_order_without_the_right_is_refused_by_the_policy_before_it_is_asked(world: World, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text(POLICY)
    world.asker.load_policy(policy)
    talk = world.talk()
    for sentence in ("turn off discovery", "connect base to 10.0.0.7", "shut down container spare"):
        with pytest.raises(AccessDenied, match="olga may not administer"):
            talk.say(sentence)
    with pytest.raises(AccessDenied, match=r"olga may not lock rosie\.head"):
        talk.say("lock the head")
    assert world.calls == []
    assert talk.say("who may move the head?").data == []
    assert "no identity may. You are olga" in talk.say("who may move the head?").text


def test_the_policy_of_the_called_container_refuses_an_order_like_the_call(world: World, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text(POLICY)
    world.rover.load_policy(policy)
    talk = world.talk()
    talk.say("turn off discovery on rover")
    with pytest.raises(AccessDenied, match=r"olga may not administer trade.set_discovery"):
        talk.say("yes")
    assert world.calls == []
    talk.say("turn off discovery")
    assert "it failed in rover: olga may not" in talk.say("yes").text
    assert sorted(world.calls) == ["base set_discovery False", "spare set_discovery False"]


def test_nothing_that_acts_is_done_where_only_questions_are_answered(world: World) -> None:
    orders = [one["say"] for one in sentences("seen.toml") if one["means"] and REQUESTS[one["means"]].is_order]
    assert len(orders) > 50
    talk = world.talk()
    for sentence in orders:
        with pytest.raises(NotUnderstood, match="only questions are answered here"):
            talk.say(sentence, orders=False, confirmed=True)
    world.memory.settle()
    assert world.calls == []
    assert world.asker.estops() == []
    assert world.asker.locks() == []


def test_a_provider_is_created_moved_and_ended(world: World, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text('[name]\n"thinker" = "tests.unit.gateway.asked_system:Planner"\n')
    talk = world.talk(read_lexicon(tmp_path / "own.toml"))
    asked = talk.say("start a thinker on spare as dora.planner").data
    assert asked == "create tests.unit.gateway.asked_system:Planner in container spare as dora.planner"
    assert world.planners() == ["rover"]
    assert talk.say("yes").text == "There is a service: dora.planner.plan."
    assert world.planners() == ["rover", "spare"]
    assert talk.say("move the planner to spare").text == "Which one do you mean: dora.planner or rosie.planner?"
    assert talk.say("rosie").text == "Shall I move rosie.planner from container rover to container spare? (yes/no)"
    assert world.planners() == ["rover", "spare"]
    assert talk.say("yes").text == "Moved: rosie.planner.plan in spare."
    assert world.planners() == ["spare", "spare"]
    assert "rosie.planner is not in container rover, but in container spare" in refused(
        talk, "move rosie.planner from rover to base"
    )
    talk.say("get rid of dora.planner")
    talk.say("yes")
    assert world.planners() == ["spare"]


def test_a_class_that_the_container_does_not_allow_is_not_created(world: World) -> None:
    with pytest.raises(NotInstantiable):
        world.talk().say("create tests.unit.gateway.asked_system:Planner on base", confirmed=True)
    assert world.planners() == ["rover"]


def test_a_dialogue_keeps_a_lock_makes_its_calls_under_it_and_releases_it(world: World, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(
        '[[phrase]]\nhear = ["nod {number}"]\ncall = "rosie.head.move"\nargs = ["{number}"]\nsay = "{result}"\n'
    )
    talk, other = world.talk(read_lexicon(tmp_path / "own.toml")), world.memory.container("other")
    assert "I hold no lock" in refused(talk, "release it")
    assert talk.say("lock the head for me").text == "You have neck, until you release it or this dialogue ends."
    with pytest.raises(LockedByOther):
        other.call(where(name="move", group="rosie.head"), 0.1)
    talk.say("nod 0.2", confirmed=True)
    assert world.calls == ["neck moves 0.2"]
    assert "for 'asked in a dialogue'" in talk.say("who has the head?").text
    assert "I hold no lock of rosie.left.arm. I hold neck" in refused(talk, "release the left arm")
    talk.say("lock the left arm")
    assert talk.say("release it").text == "Which one do you mean: neck or left?"
    assert talk.say("neck").text == "Released: neck."
    other.call(where(name="move", group="rosie.head"), 0.1)
    talk.close()
    assert world.asker.locks() == []


def test_a_lost_lock_is_reported_at_the_next_order_which_is_not_done(world: World, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(
        '[[phrase]]\nhear = ["nod {number}"]\ncall = "rosie.head.move"\nargs = ["{number}"]\nsay = "{result}"\n'
    )
    talk = world.talk(read_lexicon(tmp_path / "own.toml"))
    talk.say("lock the head")
    world.memory.container("other").break_lock("rosie.head", "it is needed")
    world.memory.settle()
    with pytest.raises(LockLost, match="it is needed"):
        talk.say("nod 0.2", confirmed=True)
    assert "neck moves 0.2" not in world.calls
    assert "I hold no lock" in refused(talk, "release it")


def test_no_lost_lock_delays_a_stop(world: World, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text('[[phrase]]\nhear = ["hush"]\ncall = "rosie.head.stop"\nsay = "{result}"\n')
    talk = world.talk(read_lexicon(tmp_path / "own.toml"))
    talk.say("lock the head")
    world.memory.container("other").break_lock("rosie.head", "it is needed")
    world.memory.settle()
    world.calls.clear()
    talk.say("hush")
    talk.say("stop the head")
    assert world.calls == ["neck stops", "neck stops"]
    talk.close()


def test_a_service_without_resources_is_locked_by_itself(world: World) -> None:
    class Lamp:
        @service
        def shine(self) -> None: ...

    world.base.register(Lamp(), "rosie.lamp")
    world.memory.settle()
    talk = world.talk()
    assert talk.say("lock the lamp").data == "rosie.lamp"
    assert "for 'asked in a dialogue'" in talk.say("who has the lamp?").text
    talk.say("release it")
    assert world.asker.locks() == []


def test_all_locks_of_a_dialogue_are_released_together(world: World) -> None:
    talk = world.talk()
    talk.say("lock the head")
    assert "you have rosie.head already" in refused(talk, "lock the head")
    talk.say("lock the left arm")
    assert talk.say("release everything").text == "Released: neck, left."
    assert world.asker.locks() == []


def test_a_single_sentence_cannot_keep_a_lock_and_says_so(world: World) -> None:
    talk = world.talk(keeps=False)
    assert "a lock of rosie.head would end with this command, so it was not taken" in refused(talk, "lock the head")
    assert world.asker.locks() == []
    assert world.calls == []


def test_what_was_stopped_moves_again_only_after_a_yes(world: World) -> None:
    talk = world.talk()
    talk.say("stop everything because of smoke")
    world.memory.settle()
    assert [one.reason for one in world.base.estops()] == ["smoke"]
    assert talk.say("clear the e-stop").waits == "yes"
    talk.say("no")
    assert talk.say("are there open e-stops").data != []
    talk.say("clear the e-stop")
    talk.say("yes")
    world.memory.settle()
    assert world.asker.estops() == []
