"""``trade ask``: sentences become calls, and what comes of them becomes sentences."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from trade import Container, service, where
from trade.errors import ConfigurationError, InvalidArgument
from trade.testing import MemorySystem
from trade_gateway.cli import app
from trade_gateway.language import Dialogue, Memory, NotUnderstood, read_lexicon

pytestmark = pytest.mark.virtual_time


class Eyes:
    @service(effect="read", achieves=["see(?x)"])
    def check_for(self, what: str) -> bool:
        """Look for something in front of the robot."""
        return what == "cup"


class Head:
    def __init__(self) -> None:
        self.turned = 0.0

    @service(effect="read", needs=["see(?x)", "at(?place)"])
    def follow(self, what: str) -> None: ...

    @service(uses="neck")
    def turn(self, angle_rad: float) -> float:
        self.turned = angle_rad
        return angle_rad

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def robot(memory: MemorySystem) -> Container:
    robot = memory.container("robot")
    robot.register(Eyes(), "rosie.eyes")
    robot.register(Head(), "rosie.head")
    return robot


@pytest.fixture
def talk(memory: MemorySystem, robot: Container) -> Dialogue:
    made = Dialogue(memory.container("asker"), read_lexicon(), Memory())
    memory.settle()
    return made


_NEEDS = (
    "rosie.head.follow needs at(?place), which no service achieves; "
    "rosie.head.follow needs see(?x), which rosie.eyes.check_for can achieve."
)


def test_P58_a_dialogue_about_the_services_that_exist(talk: Dialogue, robot: Container, memory: MemorySystem) -> None:
    host = robot.containers()[0].host
    dialogue = [
        ("Which computers are there?", f"There is one host: {host}."),
        (f"What runs on {host}?", f"On {host} there is one container: robot."),
        (
            "What services are there?",
            "There are 4 services: rosie.eyes.check_for, rosie.head.follow, rosie.head.stop, rosie.head.turn.",
        ),
        ("What can the eyes do?", "eyes has one service: rosie.eyes.check_for."),
        ("Where is the check_for service?", f"check_for is in container robot on host {host}."),
        ("Who can see?", "rosie.eyes.check_for can."),
        ("Who can fly(?x)?", "I do not know of a service that can fly(?x)."),
        (
            "How do I ask check_for?",
            "rosie.eyes.check_for is check_for(what: str) -> bool: Look for something in front of the robot.",
        ),
        ("What does the head need?", _NEEDS),
        ("What are the preconditions of follow?", _NEEDS),
        ("What does turn need?", "turn has no pre-conditions."),
        ("Who has the head?", "Nobody has it: head is free."),  # plain: Nobody
        ("Is everything all right?", "All is well."),
        ("What is new?", "I have not looked before; from now on I know."),
        ("what's new", "Nothing is new."),
    ]
    for asked, answered in dialogue:
        assert talk.say(asked).text == answered


def test_P58_new_services_are_those_that_came_and_went_since_the_last_question(
    talk: Dialogue, robot: Container, memory: MemorySystem
) -> None:
    talk.say("what is new")
    other = Eyes()
    robot.register(other, "dora.eyes")
    memory.settle()
    assert talk.say("Anything new?").text == "new: dora.eyes.check_for."
    robot.deregister(other)
    memory.settle()
    assert talk.say("What has changed?").data == {"came": [], "gone": ["dora.eyes.check_for"]}


def test_questions_about_lock_owners_and_faults_are_answered(
    talk: Dialogue, robot: Container, memory: MemorySystem
) -> None:
    other = memory.container("other")
    memory.settle()
    with other.lock(where(group="rosie.head"), purpose="looking", wait_s=20):
        reported = talk.say("Who has the head?")
        assert reported.text.startswith("tester/other has neck, for 'looking', since ")
        assert talk.say("what is locked?").data == reported.data
    dizzy = Head()
    robot.register(dizzy, "dora.head")
    robot.set_health(dizzy, "degraded: dizzy")
    memory.settle()
    assert talk.say("What is wrong?").text == "There is a problem: dora.head: degraded: dizzy."


def test_an_order_to_stop_stops_everything(talk: Dialogue, robot: Container, memory: MemorySystem) -> None:
    reported = talk.say("Stop everything because of smoke!")
    memory.settle()
    assert [one.reason for one in robot.estops()] == ["smoke"]
    assert "confirmed by" in reported.text
    assert "an e-stop is open" in talk.say("what is wrong").text


@pytest.mark.parametrize(
    ("sentence", "said"),
    [
        ("Make me a sandwich", "I do not understand that"),
        ("Who has the wings?", "I know no group 'wings'; there is rosie, rosie.eyes, rosie.head"),
        ("What runs on host mars?", "I know no host 'mars'"),
        ("Who can see(", "is not a predicate"),
        ("", "I do not understand that"),
    ],
)
def test_a_question_that_is_not_understood_lists_those_that_are(talk: Dialogue, sentence: str, said: str) -> None:
    with pytest.raises(NotUnderstood) as wrong:
        talk.say(sentence)
    assert said in str(wrong.value)


LEXICON = """
[[phrase]]
hear = ["look {number} (radians|rad) [to the left]", "turn [the] head to {number}"]
call = "rosie.head.turn"
args = ["{number}"]
say = "I look at {result} rad."

[[phrase]]
hear = ["do you see [a] {thing}"]
call = "rosie.eyes.check_for"
args = { what = "{thing}" }
say = "About the {thing}: {result}."
"""


def test_a_lexicon_of_ones_own_goes_first_and_calls_what_it_names(
    memory: MemorySystem, robot: Container, tmp_path: Path
) -> None:
    (tmp_path / "own.toml").write_text(LEXICON)
    asker = memory.container("asker")
    memory.settle()
    talk = Dialogue(asker, read_lexicon(tmp_path / "own.toml"), Memory())
    assert talk.say("Look -0.25 rad to the left!", confirmed=True).text == "I look at -0.25 rad."
    assert talk.say("do you see a cup?").text == "About the cup: true."
    assert talk.say("Do you see a teddy bear?").text == "About the teddy bear: false."
    assert talk.say("what services are there?").means == "services"


def test_a_lexicon_can_do_no_more_than_the_service_takes(
    memory: MemorySystem, robot: Container, tmp_path: Path
) -> None:
    (tmp_path / "own.toml").write_text(LEXICON.replace('args = ["{number}"]', 'args = ["{number}", 3]'))
    asker = memory.container("asker")
    memory.settle()
    with pytest.raises(InvalidArgument):
        Dialogue(asker, read_lexicon(tmp_path / "own.toml"), Memory()).say("turn the head to 0.1", confirmed=True)


PHRASE = '[[phrase]]\nhear = ["hello {name}"]\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[phrase", "own.toml"),
        (f'{PHRASE}say = "hi"\n', "needs either ask or call"),
        (
            f'{PHRASE}say = "hi"\nask = "wether"\n',
            "there is no question or order 'wether'; there is services, containers",
        ),
        (f'{PHRASE}say = "hi"\nask = "hosts"\n', "question 'hosts' has no use for {name}; it takes none"),
        (
            f'{PHRASE}say = "hi {{nmae}}"\ncall = "a.b"\n',
            "{nmae} is not part of the result; there is {name}, {result}",
        ),
        (f'{PHRASE}say = "hi"\ncall = "greet"\n', "'greet' is not a service. Write GROUP.NAME"),
        ('[[phrase]]\nhear = ["who (has"]\nask = "hosts"\nsay = "x"\n', "is not a sentence with gaps"),
        ('[[phrase]]\nhear = ["who {"]\nask = "hosts"\nsay = "x"\n', "stops making sense at '{'"),
        (f'{PHRASE}say = "hi {{"\ncall = "a.b"\n', "'hi {'"),
        (f"{PHRASE}tell = 1\n", "unknown field `tell`"),
        (None, "cannot be read"),
    ],
)
def test_a_lexicon_that_is_wrong_is_refused_with_what_would_be_right(
    tmp_path: Path, text: str | None, said: str
) -> None:
    path = tmp_path / "own.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigurationError) as wrong:
        read_lexicon(path)
    assert said in str(wrong.value)


def test_on_the_command_line_new_means_since_the_last_question(start_container, system: str) -> None:
    robot = start_container("robot")
    robot.register(Eyes(), "rosie.eyes")

    def ask(*words: str) -> str:
        done = CliRunner().invoke(app, ["ask", *words])
        assert done.exit_code == 0, done.output
        return done.stdout.strip()

    assert ask("what", "is", "new?") == "I have not looked before; from now on I know."
    robot.register(Head(), "rosie.head")
    assert json.loads(ask("anything new?", "--json"))["data"]["came"] == [
        f"rosie.head.{name}" for name in ("follow", "stop", "turn")
    ]
    done = CliRunner().invoke(app, ["ask"], input="what is new\nfoo\nwho is there\n")  # plain: is there
    assert done.stdout.splitlines()[1:] == ["Nothing is new.", "There is one container: robot."]
    assert "I do not understand that" in done.stderr
    assert "what is new" in ask("--phrases")


@pytest.mark.realtime
def test_on_the_command_line_an_order_needs_yes_and_a_lock_needs_a_dialogue(
    start_container, system: str, tmp_path: Path
) -> None:
    robot, head = start_container("robot"), Head()
    robot.register(head, "rosie.head")

    def ask(*words: str, code: int, **options: Any) -> Result:
        done = CliRunner().invoke(app, ["ask", *words], **options)
        assert done.exit_code == code, done.output
        return done

    told = ask("turn", "on", "discovery", code=1).stdout.strip()
    assert told == "I would turn on discovery in robot. Nothing was done. Add --yes to confirm it."
    assert json.loads(ask("turn on discovery", "--json", code=1).stdout)["waits"] == "yes"
    assert not robot.reach.discovers
    assert ask("turn on discovery", "--yes", code=0).stdout.strip() == "Discovery is on in robot."
    assert robot.reach.discovers
    assert "I know no container or host 'mars'" in str(ask("turn on discovery on mars", "--yes", code=1).exception)
    assert "would end with this command, so it was not taken" in str(ask("lock the head", "--yes", code=1).exception)
    assert robot.locks() == []
    assert "A dialogue asks for each order" in str(ask("--yes", code=1, input="").exception)
    dialogue = ask(code=0, input="lock the head\nwho has the head\nturn off discovery\nyes\nrelease it\n").stdout
    assert dialogue.splitlines()[1] == "You have neck, until you release it or this dialogue ends."
    assert "for 'asked in a dialogue'" in dialogue
    assert "Shall I turn off discovery in robot? (yes/no)\nDiscovery is off in robot.\nReleased: neck." in dialogue
    assert not robot.reach.discovers
    answer = '{"request": "discovery_on", "gaps": {"place": "robot"}}'
    (tmp_path / "model.py").write_text(f"print({answer!r})")
    model = f"--model={sys.executable} {tmp_path / 'model.py'}"
    said = ask("robot soll discovery anmachen", model, code=1).stdout
    assert said.splitlines()[0] == "the model proposes discovery_on(place='robot')"
    assert not robot.reach.discovers
    ask("robot soll discovery anmachen", model, "--yes", code=0)
    assert robot.reach.discovers
    assert head.turned == 0.0
