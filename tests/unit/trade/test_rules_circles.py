"""Rules that bring themselves about again and again are stopped; what may have led to what."""

import json
import logging

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.rules_fixture import SOON_S, TELL, Desk, Engine, Lamp
from trade import Container, service, where
from trade.rules import Firing
from trade.rules import _engine as rules_module
from trade.rules import _steps as causes
from trade.rules._steps import LoopDetector, RuleMark, turns

pytestmark = pytest.mark.virtual_time


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rules_module, "LOOK_S", SOON_S)


class Toggle:
    """Offers a lamp and withdraws it again, on request."""

    def __init__(self, container: Container) -> None:
        self._container = container
        self._lamp = Lamp()
        self.turns = 0

    @service
    def offer(self) -> None:
        self.turns += 1
        self._container.register(self._lamp, "hall")

    @service
    def withdraw(self) -> None:
        self._container.deregister(self._lamp)


def health(container: Container) -> str:
    return container.find(where(name="rules", kind="Rules"), wait_s=20).health


@pytest.mark.parametrize("offers", ["left", "missing"])
def test_rules_that_trigger_each_other_endlessly_are_stopped_and_reported(
    there: Container,
    engine: Engine,
    offers: str,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(causes, "AFTERMATH_NS", 600 * 10**9)  # however slow this machine is
    toggle = Toggle(there)
    there.register(toggle, "toggle")
    [offer] = there.services(where(name="offer"))
    wait_until(lambda: engine._container.services(where(name="offer")))
    running = engine(f"""
        [rule.back]
        when = {{ {offers} = {{ name = "switch" }} }}
        do = [{{ call = {{ name = "offer" }} }}]
        cooldown_s = {0.001 if offers == "missing" else 0}
        [rule.away]
        when = {{ joined = {{ name = "switch" }} }}
        do = [{{ call = {{ name = "withdraw" }} }}]
        """)
    if offers == "left":
        offer()
    wait_until(lambda: any(info.state == "stopped" for info in running.rules()))
    [stopped] = [info for info in running.rules() if info.state == "stopped"]
    assert stopped.why.startswith("it triggers itself, 3 times over: ")
    assert {"back", "away"} <= set(stopped.why.replace(":", " ").split())
    wait_until(lambda: stopped.why[:60] in health(there))
    firing = next(firing for firing in iter(engine.next, None) if firing.stopped)
    assert (firing.rule, firing.ok, firing.steps) == (stopped.name, False, ())
    assert len(firing.led_by) >= 6
    assert any(record.levelno == logging.ERROR and stopped.name in record.message for record in caplog.records)
    audited = [json.loads(line) for line in engine.audit.read_text().splitlines()]
    assert [line["rule"] for line in audited if line["stopped"]] == [stopped.name]  # not the last: a step may end later
    assert toggle.turns <= causes.TURNS + 2


def test_a_stopped_rule_restarts_when_the_file_is_read_again(here: Container, there: Container, engine: Engine) -> None:
    def come_and_go() -> Firing:
        lamp = Lamp()
        there.register(lamp, "hall")
        firing = engine.next()
        there.deregister(lamp)
        wait_until(lambda: not here.services(where(name="switch")))
        return firing

    text = '[rule.r]\nwhen = { joined = { name = "switch" } }\ndo = [{ wait_for = { name = "rules" } }]\n'
    running = engine(text)
    while not come_and_go().stopped:
        pass
    wait_until(lambda: health(there).startswith("stopped: rule r:"))
    running.load(engine.file)
    assert come_and_go().ok
    assert running.rules()[0].state == "standing"
    wait_until(lambda: health(there) == "healthy")


def test_a_rule_that_fires_too_often_is_stopped(
    there: Container, desk: Desk, engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(causes, "AFTERMATH_NS", 0)  # nothing is its own doing
    running = engine(f'[rule.r]\nwhen = {{ joined = {{ name = "switch" }} }}\n{TELL}')
    for number in range(10):
        lamp = Lamp()
        there.register(lamp, "hall")
        there.deregister(lamp)
        if number < rules_module.MOST:
            desk.next()
    wait_until(lambda: running.rules()[0].state == "stopped")
    [info] = running.rules()
    assert (info.fired, info.why) == (5, "it fired 5 times within 60 s; give it a longer cooldown_s")
    assert desk.heard.empty()


def test_many_services_that_leave_together_are_no_circle(there: Container, desk: Desk, engine: Engine) -> None:
    running = engine(f'[rule.r]\nwhen = {{ left = {{ name = "switch" }} }}\n{TELL}')
    lamps = [Lamp() for _ in range(20)]
    for number, lamp in enumerate(lamps):
        there.register(lamp, f"room{number}")
    wait_until(lambda: len(running.container.services(where(name="switch"))) == 20)
    for lamp in lamps:
        there.deregister(lamp)
    assert {desk.next()[0] for _ in lamps} == {f"room{number}.switch" for number in range(20)}
    assert running.rules()[0].state == "standing"


def fire(known: LoopDetector, mark: RuleMark, since_ns: int = 0, ended_ns: int | None = 0) -> int:
    way = known.way_to(mark, since_ns)
    known.begin(way).ended_ns = ended_ns
    return turns(way)


def test_a_circle_of_rules_is_counted_each_time_it_closes() -> None:
    known, a, b = LoopDetector(), RuleMark("a", "x"), RuleMark("b", "x")
    assert [fire(known, mark) for mark in (a, b, a, b, a, b, a)] == [0, 0, 1, 1, 2, 2, 3]


def test_what_ended_long_before_led_to_nothing() -> None:
    known, a = LoopDetector(), RuleMark("a", "x")
    late = causes.AFTERMATH_NS + 1
    assert [fire(known, a, since, since) for since in (0, late, 2 * late)] == [0, 0, 0]


def test_what_is_under_way_may_lead_to_anything() -> None:
    known, a, b = LoopDetector(), RuleMark("a"), RuleMark("b")
    fire(known, a, ended_ns=None)
    assert known.way_to(b, 10 * causes.AFTERMATH_NS) == (a, b)


def test_the_same_rule_for_another_service_is_another_occasion() -> None:
    known = LoopDetector()
    assert [fire(known, RuleMark("a", str(number))) for number in range(9)] == [0] * 9
