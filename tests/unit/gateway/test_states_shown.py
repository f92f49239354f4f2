"""``trade containers --show``: what containers answer about their states, as people and programs see it."""

import json
from collections.abc import Callable

import pytest

from tests.support.waiting import wait_until
from trade import Container, service, where
from trade.testing import memory_system
from trade.transport.memory import MessageKind
from trade_gateway.cli.services._states import State, say_state
from trade_gateway.language import Dialogue, Memory, read_lexicon
from trade_gateway.terminal._output import Output

StartContainer = Callable[..., Container]


class Lamp:
    @service(effect="read")
    def lit(self) -> bool:
        return True


@pytest.fixture
def looking(start_container: StartContainer) -> Container:
    """Looks at a lamp and a container that listens to it."""
    lamps, mind, looking = (start_container(name) for name in ("lamps", "mind", "looking"))
    lamps.register(Lamp(), "lamp")
    stream = mind.stream(mind.find(where(name="lit"), wait_s=20))
    mind.system.set_discovery(True)
    asked = where(name="network", container="mind")
    wait_until(lambda: {link.to for link in looking.call(asked).links} == {"lamps", "looking"}, "all are linked")
    assert not stream.ended
    return looking


def shown(looking: Container, state: State, capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    """The words of each line, and no warning."""
    say_state(Output(as_json=False), looking, state)
    said = capsys.readouterr()
    assert said.err == ""
    return [line.split() for line in said.out.splitlines()]


def test_states_are_shown_for_each_other_container(looking: Container, capsys: pytest.CaptureFixture[str]) -> None:
    links = shown(looking, State.LINKS, capsys)
    assert [line[:2] for line in links[1:]] == [["lamps", "mind"], ["mind", "lamps"]]
    network = shown(looking, State.NETWORK, capsys)
    assert [line[:3] for line in network[1:]] == [["lamps", "off", "off"], ["mind", "on", "off"]]
    [_, listener] = shown(looking, State.LISTENERS, capsys)
    assert listener[0] == "lamp.lit"
    assert listener[1].split("/")[1] == "mind"
    events = shown(looking, State.EVENTS, capsys)
    assert ["mind", "discovery", "mind", "on"] in [line[1:] for line in events]


def test_states_are_objects_for_programs(looking: Container, capsys: pytest.CaptureFixture[str]) -> None:
    say_state(Output(as_json=True), looking, State.NETWORK)
    found = {one["container"]: one for one in json.loads(capsys.readouterr().out)}
    assert {name: one["discovery"] for name, one in found.items()} == {"lamps": False, "mind": True}


def test_sentences_about_links_and_switches_are_answered(looking: Container) -> None:
    talk = Dialogue(looking, read_lexicon(), Memory())
    said = {sentence: talk.say(sentence).text for sentence in ("what is linked?", "is discovery on in mind?")}
    assert said["what is linked?"] == "There is one link: lamps is linked with mind."
    assert said["is discovery on in mind?"] == "mind has discovery on and broadcasting off."
    looking.call(where(name="set_discovery", container="mind"), False)
    assert talk.say("is discovery on?").text == (
        "lamps has discovery off and broadcasting off; mind has discovery off and broadcasting off."
    )


@pytest.mark.virtual_time
def test_a_container_that_has_not_listed_its_services_yet_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with memory_system() as system:
        looking = system.container("looking")
        system.lose(lambda message: message.kind is MessageKind.ANSWER and message.source == "lamps")
        system.container("lamps").register(Lamp(), "lamp")
        looking.find("lamp.lit")
        say_state(Output(as_json=False), looking, State.NETWORK)
        assert capsys.readouterr().err == "warning: lamps did not answer: it has not listed its services\n"
        answer = Dialogue(looking, read_lexicon(), Memory()).say("is discovery on?")
        assert "of lamps it is not known, it does not answer" in answer.text
