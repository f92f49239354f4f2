"""Stories of robots under drawn troubles keep the rules of motion, and the judge sees it where a product does not."""

import math
import re
from collections.abc import Iterable
from typing import Any

import pytest

from tests.endurance.explore._story import play
from trade._resources.lock_table import LockTable
from trade._resources.resource import Resource

SEEDS = 50


@pytest.mark.parametrize("seed", range(1, SEEDS + 1))
def test_motion_keeps_its_rules_whatever_happens(seed: int) -> None:
    assert play(seed).violations == []


def test_the_same_seed_gives_the_same_story() -> None:
    assert str(play(7)) == str(play(7))


def _no_stop_holds(patch: pytest.MonkeyPatch) -> None:
    def check(self: Resource, tokens: Iterable[Any], caller: str, session: str = "") -> None:
        self.check_lock(tokens, caller, session)

    patch.setattr(Resource, "check", check)


def _two_owners(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(LockTable, "_obstacle", lambda *_: None)


def _no_lease_ends(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(LockTable, "expire", lambda _: math.inf)
    patch.setattr(LockTable, "session_ended", lambda *_: None)


@pytest.mark.parametrize(
    ("mutate", "says"),
    [
        (_no_stop_holds, "stop was confirmed"),
        (_two_owners, "and (worker|planner) held"),
        (_no_lease_ends, "still has"),
    ],
)
def test_the_judge_sees_what_is_wrong(mutate: Any, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mutate(monkeypatch)
    assert any(re.search(says, "\n".join(play(seed).violations)) for seed in range(1, SEEDS))
