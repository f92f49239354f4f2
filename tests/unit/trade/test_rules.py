"""Rules at work: on this occasion, if this holds, these steps."""

import json
import logging
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.rules_fixture import NOTE, SOON_S, TELL, Desk, Engine, Lamp
from trade import Container, service, where
from trade.errors import AccessDenied, ConfigurationError
from trade.rules import Rules, read_rules, rehearse
from trade.rules import _engine as rules_module

pytestmark = pytest.mark.virtual_time


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rules_module, "LOOK_S", SOON_S)


@pytest.mark.parametrize("kind", ["joined", "left"])
def test_a_rule_fires_with_what_joins_or_leaves(there: Container, desk: Desk, engine: Engine, kind: str) -> None:
    engine(f'[rule.r]\nwhen = {{ {kind} = {{ name = "switch" }} }}\n{TELL}')
    lamp = Lamp()
    there.register(lamp, "hall")
    there.deregister(lamp)
    assert desk.next() == ("hall.switch", "there")
    firing = engine.next()
    assert (firing.rule, firing.service, firing.occasion) == ("r", "hall.switch", f"{kind} name='switch'")
    [did] = firing.steps
    assert (did.service, did.container, did.result, did.error) == ("desk.tell", "here", "'noted'", "")


def test_a_rule_fires_when_a_service_becomes_as_it_says_and_not_when_it_ceases_to_be(
    there: Container, desk: Desk, engine: Engine
) -> None:
    engine(f'[rule.r]\nwhen = {{ changed = {{ name = "switch", healthy = false }} }}\n{TELL}')
    lamp, other = Lamp(), Lamp()
    there.register(lamp, "hall")
    there.register(other, "attic")
    there.set_health(lamp, "flickers")
    assert desk.next() == ("hall.switch", "there")
    there.set_health(lamp)
    there.set_health(other, "flickers")
    assert desk.next() == ("attic.switch", "there")


def test_a_rule_fires_while_a_service_is_missing(here: Container, desk: Desk, engine: Engine) -> None:
    running = engine(f'[rule.r]\nwhen = {{ missing = {{ name = "switch" }} }}\n{NOTE}\ncooldown_s = {SOON_S}')
    assert [desk.next(), desk.next()] == ["x", "x"]
    here.register(Lamp(), "hall")
    wait_for_looks(here)  # one may have been under way
    fired = running.rules()[0].fired
    wait_for_looks(here)
    assert (running.rules()[0].fired, running.rules()[0].state) == (fired, "standing")


def test_what_is_missing_longer_than_its_steps_take_waits_for_the_cooldown(
    here: Container, desk: Desk, engine: Engine
) -> None:
    running = engine(f'[rule.r]\nwhen = {{ missing = {{ name = "switch" }} }}\n{NOTE}\ncooldown_s = 600')
    engine.next()
    wait_for_looks(here)
    assert running.rules()[0].fired == 1


def test_a_rule_fires_for_each_service_that_is_present_while_its_condition_holds(
    here: Container, there: Container, desk: Desk, engine: Engine
) -> None:
    desk.wanted = True
    there.register(Lamp(), "hall")
    there.register(Lamp(), "attic")
    wait_until(lambda: len(here.services(where(name="switch"))) == 2)
    running = engine(
        '[rule.r]\nwhen = { present = { name = "switch" } }\nif = { service = { name = "is_wanted" } }\n'
        f"{TELL}\ncooldown_s = 600"
    )
    assert {desk.next()[0], desk.next()[0]} == {"hall.switch", "attic.switch"}
    wait_for_looks(here)
    assert running.rules()[0].fired == 2  # each once in its cooldown
    desk.wanted = False
    there.register(Lamp(), "porch")
    wait_until(lambda: here.services(where(name="switch", group="porch")))
    wait_for_looks(here)
    assert running.rules()[0].fired == 2
    desk.wanted = True
    assert desk.next()[0] == "porch.switch"


def wait_for_looks(here: Container) -> None:
    """Until it has been looked for what is missing a few times more."""

    def looks() -> int:
        return sum(info.fired for info in here.notifications() if info.occasion.startswith("every"))

    before = looks()
    wait_until(lambda: looks() >= before + 4)


def test_occasions_during_the_cooldown_are_left_out_for_that_service_alone(
    there: Container, desk: Desk, engine: Engine
) -> None:
    running = engine(f'[rule.r]\nwhen = {{ joined = {{ name = "switch" }} }}\n{TELL}\ncooldown_s = 600')
    for _ in range(3):
        lamp = Lamp()
        there.register(lamp, "hall")
        there.deregister(lamp)
    there.register(Lamp(), "attic")
    assert [desk.next()[0], desk.next()[0]] == ["hall.switch", "attic.switch"]
    assert running.rules()[0].skipped == 2


def test_a_rule_of_time_fires_only_while_its_condition_holds(desk: Desk, engine: Engine) -> None:
    engine(f'[rule.r]\nwhen = {{ every_s = {SOON_S} }}\nif = {{ service = {{ name = "is_wanted" }} }}\n{NOTE}')
    wait_until(lambda: desk.asked >= 3)
    assert desk.heard.empty()
    desk.wanted = True
    assert desk.next() == "x"


def test_a_condition_compares_a_field_of_an_answer(desk: Desk, engine: Engine) -> None:
    condition = 'if = { service = { name = "strain" }, field = "cpu", above = 0.8 }'
    engine(f"[rule.r]\nwhen = {{ every_s = {SOON_S} }}\n{condition}\n{NOTE}")
    wait_until(lambda: desk.asked >= 3)
    assert desk.heard.empty()
    desk.cpu = 0.9
    assert desk.next() == "x"


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ('{ name = "note" }', "does not only read, so it is no condition"),
        ('{ name = "missing" }', "NoSuchService"),
        ('{ name = "strain" }', "needs above, below or is: it answers {'cpu': 0.1}"),
        ('{ name = "strain" }, field = "memory", above = 1', "the answer has none"),
        ('{ name = "is_wanted" }, above = 1', "which is no number"),
    ],
    ids=["actuates", "missing", "no comparison", "no such field", "no number"],
)
def test_a_condition_that_cannot_be_evaluated_does_not_hold_and_is_reported_once(
    desk: Desk, engine: Engine, condition: str, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "trade.rules"):
        running = engine(f"[rule.r]\nwhen = {{ every_s = {SOON_S} }}\nif = {{ service = {condition} }}\n{NOTE}")
        wait_until(lambda: running.rules()[0].failed >= 3)
    [info] = running.rules()
    assert said in info.last_error
    assert (info.fired, desk.heard.empty()) == (0, True)
    assert caplog.text.count(said) == 1


def test_after_a_step_that_fails_only_those_are_done_that_always_are(desk: Desk, engine: Engine) -> None:
    engine("""
        [rule.r]
        when = { missing = { name = "switch" } }
        do = [
          { call = { name = "note" }, args = { word = "on" } },
          { wait_for = { name = "switch" }, s = 0 },
          { call = { name = "note" }, args = ["seen"] },
          { call = { name = "note" }, args = ["off"], always = true },
          { call = { name = "fail" }, always = true },
        ]
        cooldown_s = 600
        """)
    firing = engine.next()
    assert [desk.next(), desk.next()] == ["on", "off"]
    assert desk.heard.empty()
    assert [did.error.partition(":")[0] for did in firing.steps] == ["", "NoSuchService", "", "OSError"]
    assert not firing.ok
    assert engine.running is not None
    [info] = engine.running.rules()
    assert (info.fired, info.failed, info.last_error, info.state) == (1, 2, "OSError: no ink", "standing")


def test_the_service_that_changed_is_called_itself(there: Container, engine: Engine) -> None:
    class Oven:
        switched = threading.Event()

        @service
        def off(self) -> None:
            self.switched.set()

    oven = Oven()
    there.register(oven, "kitchen")
    engine('[rule.r]\nwhen = { changed = { healthy = false, name = "off" } }\ndo = [{ call = "$service" }]')
    wait_until(lambda: engine.running is not None and engine.running.container.services(where(name="off")))
    there.set_health(oven, "overheating")
    assert oven.switched.wait(20)


def test_every_firing_is_audited_in_a_file_and_as_a_service(there: Container, desk: Desk, engine: Engine) -> None:
    engine(f'[rule.r]\nwhen = {{ joined = {{ name = "switch" }} }}\n{TELL}')
    there.register(Lamp(), "hall")
    there.register(Lamp(), "attic")
    firings = [engine.next(), engine.next()]
    lines = [json.loads(line) for line in engine.audit.read_text().splitlines()]
    assert [line["service"] for line in lines] == [firing.service for firing in firings]
    assert lines[0]["steps"][0]["result"] == "'noted'"
    reported = there.find(where(name="rule_firings"), wait_s=20)()
    assert reported == firings
    [info] = there.call(where(name="rules", kind="Rules"))
    assert (info.name, info.container, info.state, info.fired) == ("r", "here", "standing", 2)


def test_an_audit_file_that_cannot_be_written_ends_nothing(
    desk: Desk, engine: Engine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    engine.audit = tmp_path / "no such folder" / "audit.jsonl"
    engine(f"[rule.r]\nwhen = {{ every_s = {SOON_S} }}\n{NOTE}")
    assert [engine.next().ok, engine.next().ok] == [True, True]
    assert "cannot be written" in caplog.text


def test_a_dry_run_says_on_each_occasion_what_it_would_call_and_calls_nothing(
    there: Container, desk: Desk, engine: Engine
) -> None:
    engine(
        """
        [rule.r]
        when = { joined = { name = "switch" } }
        do = [
          { call = { name = "missing" } },
          { call = { name = "tell" }, args = ["$service"] },
          { wait_for = { name = "switch" } },
        ]
        """,
        dry_run=True,
    )
    there.register(Lamp(), "hall")
    firing = engine.next()
    assert firing.dry_run
    assert [did.error.partition(":")[0] for did in firing.steps] == ["NoSuchService", "", ""]
    assert [did.result for did in firing.steps] == ["", "would be called", "exists"]
    assert desk.heard.empty()


def test_a_dry_run_says_which_rules_would_fire_now(here: Container, desk: Desk, tmp_path: Path) -> None:
    file = tmp_path / "rules.toml"
    file.write_text(f"""
        [rule.absent]
        when = {{ missing = {{ name = "switch" }} }}
        {NOTE}
        cooldown_s = 60
        [rule.timed]
        when = {{ every_s = 5 }}
        if = {{ service = {{ name = "is_wanted" }} }}
        {NOTE}
        [rule.coming]
        when = {{ joined = {{ name = "strain" }} }}
        {TELL}
        [rule.going]
        when = {{ left = {{ name = "switch" }} }}
        {TELL}
        """)
    reported = {rehearsal.rule: rehearsal for rehearsal in rehearse(here, read_rules(file))}
    assert {name: rehearsal.fires for name, rehearsal in reported.items()} == {
        "absent": True,
        "timed": False,
        "coming": False,
        "going": False,
    }
    assert [rehearsal.now for rehearsal in reported.values()] == [
        "nothing matches",
        "the condition does not hold",
        "1 match: desk.strain",
        "nothing matches",
    ]
    assert [did.service for did in reported["coming"].steps] == ["desk.tell"]
    assert reported["going"].steps == ()
    assert desk.heard.empty()


def test_a_rule_does_what_its_container_may_at_each_call(start_container: Any, engine: Engine, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    text = """
    [roles.ruler]
    register = ["rules", "desk"]
    read = ["desk", "rules"]
    MAY
    [identities]
    ruler = ["ruler"]
    """
    policy.write_text(text.replace("MAY", ""))
    ruler, desk = start_container("ruler", identity="ruler", policy=policy), Desk()
    ruler.register(desk, "desk")
    file = tmp_path / "rules.toml"
    file.write_text(f"[rule.r]\nwhen = {{ every_s = {SOON_S} }}\n{NOTE}")
    with Rules(ruler, file) as running:
        wait_until(lambda: running.rules()[0].fired >= 2)
        assert running.rules()[0].last_error.startswith("AccessDenied: ruler may not call desk.note")
        [rehearsal] = rehearse(ruler, read_rules(file))
        assert rehearsal.steps[0].error.startswith("AccessDenied: ruler may not call desk.note")
        assert desk.heard.empty()
        policy.write_text(text.replace("MAY", 'call = ["desk"]'))
        ruler.load_policy(policy)
        assert desk.next() == "x"


def test_rules_are_offered_only_by_who_may(start_container: Any, tmp_path: Path) -> None:
    policy, file = tmp_path / "policy.toml", tmp_path / "rules.toml"
    policy.write_text('[roles.none]\ncall = ["*"]\n[identities]\nruler = ["none"]\n')
    file.write_text(f"[rule.r]\nwhen = {{ every_s = 1 }}\n{NOTE}")
    ruler = start_container("ruler", identity="ruler", policy=policy)
    with pytest.raises(AccessDenied, match="ruler may not register"):
        Rules(ruler, file)
    assert ruler.notifications() == []


def test_a_changed_file_begins_new_rules_ends_old_ones_and_leaves_the_others_alone(desk: Desk, engine: Engine) -> None:
    same = f"[rule.same]\nwhen = {{ every_s = {SOON_S} }}\n{NOTE}\n"
    running = engine(same + f"[rule.old]\nwhen = {{ every_s = 60 }}\n{NOTE}\n")
    wait_until(lambda: running.rules()[1].fired >= 2)
    engine.file.write_text(same + f"[rule.new]\nwhen = {{ every_s = 50 }}\n{NOTE}\n")
    running.load(engine.file)
    new, kept = running.rules()
    assert (new.name, kept.name, kept.fired >= 2) == ("new", "same", True)
    assert len(running.container.notifications()) == 2


def test_a_wrong_file_changes_nothing(desk: Desk, engine: Engine) -> None:
    running = engine(f"[rule.r]\nwhen = {{ every_s = {SOON_S} }}\n{NOTE}\n")
    engine.file.write_text("[rule.other]\n")
    with pytest.raises(ConfigurationError, match=r"rule\.other: when is missing"):
        running.load(engine.file)
    fired = running.rules()[0].fired
    wait_until(lambda: running.rules()[0].fired > fired)


def test_closed_rules_leave_nothing_behind(here: Container, desk: Desk, engine: Engine) -> None:
    running = engine(f"[rule.r]\nwhen = {{ every_s = 60 }}\n{NOTE}\n")
    running.close()
    running.close()
    assert here.notifications() == []
    assert here.services(where(group="rules")) == []
