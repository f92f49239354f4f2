"""``trade ask --model``: a model maps free text onto the same requests, and nothing that it says runs unchecked."""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.gateway.asked_system import World, world
from trade.errors import ConfigurationError
from trade_gateway.language import Dialogue, Memory, Model, NotUnderstood, read_lexicon

__all__ = ["world"]

RECORDED = """
import json, pathlib, sys
asked = json.load(sys.stdin)
pathlib.Path(sys.argv[1]).write_text(json.dumps(asked))
print(json.loads(pathlib.Path(sys.argv[2]).read_text())[asked["sentence"]])
"""
Recorded = Callable[..., Model]


@pytest.fixture
def recorded(tmp_path: Path) -> Recorded:
    """A model that was recorded: an answer for each sentence, as an object or as a raw text."""

    def model(answers: Mapping[str, Any], **options: Any) -> Model:
        texts = {asked: text if isinstance(text, str) else json.dumps(text) for asked, text in answers.items()}
        (tmp_path / "answers.json").write_text(json.dumps(texts))
        (tmp_path / "model.py").write_text(RECORDED)
        files = [tmp_path / name for name in ("model.py", "asked.json", "answers.json")]
        return Model([sys.executable, *map(str, files)], **options)

    return model


def talk_with(world: World, model: Model, shown: list[str] | None = None) -> Dialogue:
    show = [].append if shown is None else shown.append
    return Dialogue(world.asker, read_lexicon(), Memory(), keeps=True, model=model, show=show)


def nothing_happened(world: World) -> bool:
    world.memory.settle()
    return world.calls == [] and not world.asker.estops() and not world.asker.locks()


@pytest.mark.realtime
def test_a_question_in_free_text_is_shown_and_answered(world: World, recorded: Recorded, tmp_path: Path) -> None:
    shown: list[str] = []
    sentence = "wer hat den Kopf?"
    talk = talk_with(world, recorded({sentence: {"request": "locks", "gaps": {"group": "head"}}}), shown)
    assert talk.say(sentence).text == "Nobody has it: head is free."  # plain: Nobody
    assert shown == ["locks(group='head')"]
    asked = json.loads((tmp_path / "asked.json").read_text())
    assert asked["names"]["containers"] == ["base", "rover"]
    offered = {one["request"]: one for one in asked["requests"]}
    assert offered["migrate"]["gaps"] == ["group", "place", "source"]
    assert offered["migrate"]["needed"] == ["group", "place"]
    assert (offered["migrate"]["order"], offered["locks"]["order"]) == (True, False)
    assert not {"yes", "no", "again"} & set(offered)


@pytest.mark.realtime
def test_an_order_in_free_text_is_shown_and_needs_the_same_confirmation(world: World, recorded: Recorded) -> None:
    shown: list[str] = []
    sentence = "Schalte die Discovery auf base aus"
    model = recorded({sentence: {"request": "discovery_off", "gaps": {"place": "base"}}})
    talk = talk_with(world, model, shown)
    assert talk.say(sentence).text == "Shall I turn off discovery in base? (yes/no)"
    assert shown == ["discovery_off(place='base')"]
    assert nothing_happened(world)
    talk.say("yes")
    assert world.calls == ["base set_discovery False"]


@pytest.mark.realtime
def test_a_stop_or_a_lock_that_a_model_reads_into_a_sentence_needs_a_yes(world: World, recorded: Recorded) -> None:
    stop, lock = "it would be good if the motion stopped", "reserviere den head"
    answers = {stop: {"request": "estop"}, lock: {"request": "lock", "gaps": {"group": "head"}}}
    talk = talk_with(world, recorded(answers))
    assert talk.say(stop).text == "Shall I stop the whole system? (yes/no)"
    assert talk.say(lock).waits == "yes"
    assert nothing_happened(world)
    talk.say("yes")
    assert [lock.holder.purpose for lock in world.asker.locks()] == ["asked in a dialogue"]
    talk.close()


def test_a_model_is_not_asked_about_what_the_lexicon_understands(world: World) -> None:
    talk = talk_with(world, Model(["/nonexistent/model"]))
    talk.say("stop the head")
    assert world.calls == ["neck stops"]


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("sentence", "answer", "said"),
    [
        ("blah", "I think you want to stop", "answered no request as JSON"),
        ("blah", "", "answered no request as JSON"),
        ("blah", "[]", "answered no request as JSON"),
        ("blah", '{"request": "locks"} and more', "answered no request as JSON"),
        ("blah", '[{"request": "locks"}, {"request": "estop"}]', "answered no request as JSON"),
        ("blah", {"request": "locks", "run": "rm"}, "answered no request as JSON"),
        ("blah", {"request": "locks", "gaps": {"group": 3}}, "answered no request as JSON"),
        ("blah", "[" * 30_000, "answered no request as JSON"),
        ("blah", {"request": ""}, "knows no request for it either"),
        ("blah", {"request": "self_destruct"}, "proposed self_destruct(), which no phrase of the lexicon means"),
        ("blah", {"request": "locks", "gaps": {"place": "base"}}, "which no phrase of the lexicon means"),
        ("blah", {"request": "migrate", "gaps": {"group": "planner"}}, "which no phrase of the lexicon means"),
        ("move head", {"request": "migrate", "gaps": {"group": "head", "place": ""}}, "which no phrase"),
        (
            "get head onto the net",
            {"request": "connect", "gaps": {"endpoint": "a b;c"}},
            "which no phrase of the lexicon means",
        ),
        ("quite so", {"request": "yes"}, "which no phrase of the lexicon means"),
        ("blah", {"request": "locks", "gaps": {"group": "wings"}}, "I know no group 'wings'"),
        ("what about the head of base then?", {"request": "stop", "gaps": {"group": "head"}}, "for a question"),
        ("how do you do", {"request": "estop"}, "proposed an order (estop) for a question. Nothing was done"),
        ("good morning", {"request": "estop"}, "that the sentence does not ask for. Nothing was done"),
        ("it is warm", {"request": "end_container", "gaps": {"container": "base"}}, "does not ask for"),
    ],
)
def test_what_a_model_should_not_say_is_refused_and_nothing_happens(
    world: World, recorded: Recorded, sentence: str, answer: Any, said: str
) -> None:
    with pytest.raises(NotUnderstood) as wrong:
        talk_with(world, recorded({sentence: answer})).say(sentence, confirmed=True)
    assert said in str(wrong.value)
    assert nothing_happened(world)


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("import time; time.sleep(60)", "took more than 0.5 s. Nothing was done"),
        ("import sys\nwhile True: sys.stdout.write('x' * 65536)", "printed more than 64 KiB. Nothing was done"),
        ("print('x' * 100_000)", "printed more than 64 KiB. Nothing was done"),
        ("raise SystemExit(3)", "failed with code 3. Nothing was done"),
    ],
)
def test_a_model_that_fails_is_ended_and_nothing_happens(world: World, program: str, said: str) -> None:
    limit_s = 0.5 if "sleep" in program else 30.0
    with pytest.raises(ConfigurationError) as wrong:
        talk_with(world, Model([sys.executable, "-c", program], limit_s)).say("do something about the head")
    assert said in str(wrong.value)
    assert nothing_happened(world)


@pytest.mark.realtime
def test_what_a_model_has_started_ends_with_it(world: World, tmp_path: Path) -> None:
    child, pid = "import time; time.sleep(60)", tmp_path / "pid"
    program = f"""
import pathlib, subprocess, sys
process = subprocess.Popen([sys.executable, "-c", {child!r}])
pathlib.Path({str(pid)!r}).write_text(str(process.pid))
print('{{"request": "locks"}}')
"""
    talk_with(world, Model([sys.executable, "-c", program])).say("blah")
    status = Path(f"/proc/{pid.read_text()}/stat")
    wait_until(lambda: not status.exists() or ") Z" in status.read_text())


@pytest.mark.realtime
def test_a_model_that_cannot_be_run_is_named(world: World) -> None:
    with pytest.raises(ConfigurationError, match=r"--model /nonexistent/model: cannot be run"):
        talk_with(world, Model("/nonexistent/model")).say("blah")
    with pytest.raises(ConfigurationError, match="names no command"):
        Model(" ")
    assert nothing_happened(world)
