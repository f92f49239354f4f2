"""The observer example, over three processes: one plans, one asks for plans, one watches and is known to neither."""

import queue
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Container, HookEvent, service, where

pytestmark = pytest.mark.realtime

PLANNER = """
class Planner:
    @service
    def plan(self, goal: str) -> list[str]:
        if goal == "fly":
            raise ValueError("no wings")
        return ["find " + goal, "take " + goal]

Container(Settings.read(container="mind")).register(Planner(), "mind")
say("ready")
hear()
"""

BOSS = """
plan = Container(Settings.read(container="boss")).find(where(name="plan"), wait_s=20)
say("ready")
while goal := hear():
    try:
        say(*plan(goal))
    except ValueError as no:
        say(no)
"""


class Observer:
    def __init__(self) -> None:
        self.seen: queue.SimpleQueue[HookEvent] = queue.SimpleQueue()

    @service(effect="read")
    def add_observed_output(self, called: HookEvent) -> None:
        self.seen.put(called)


def test_an_observer_sees_what_one_process_asks_of_another_and_what_comes_of_it(
    here: Container, start_program: Any
) -> None:
    observer = Observer()
    [add] = here.register(observer, "eye")
    mind, boss = start_program(PLANNER), start_program(BOSS)
    assert (mind.heard(), boss.heard()) == ("ready", "ready")
    hook = here.after_service(where(name="plan", group="mind"), add)
    wait_until(lambda: any(info.services for info in hook.infos()))

    boss.tell("tea")
    assert boss.heard() == "find tea take tea"
    seen = observer.seen.get(timeout=20)
    assert (seen.args, seen.result, seen.service.container) == ({"goal": "tea"}, ["find tea", "take tea"], "mind")
    assert seen.session.split("/")[1] == "boss"

    boss.tell("fly")
    assert boss.heard() == "no wings"
    seen = observer.seen.get(timeout=20)
    assert (seen.args, seen.ok, seen.error) == ({"goal": "fly"}, False, "ValueError: no wings")

    hook.detach()
    boss.tell("rest")
    assert boss.heard() == "find rest take rest"
    assert observer.seen.empty()
