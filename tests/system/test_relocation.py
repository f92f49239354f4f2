"""A host is lost: what is leased is back on the other one, with its state, and never alive on both.

Each object writes when it was alive, by a clock of the kernel that both hosts share: these files are the judge.
"""

import os
import random
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.system.networks import Networks
from tests.system.two_hosts import LEASE_S, Life, TwoHosts, now, overlaps, two_hosts

ROUNDS = int(os.environ.get("SOAK_ROUNDS", "4"))
SEED = int(os.environ.get("SEED", "1"))
pytestmark = [pytest.mark.timeout(180 + 90 * ROUNDS)]


@pytest.fixture
def hosts(networks: Networks, tmp_path: Path, system: str) -> Iterator[TwoHosts]:
    with two_hosts(networks, tmp_path, system) as made:
        yield made


def _rest(dice: random.Random, longest_s: float) -> None:
    threading.Event().wait(dice.uniform(0, longest_s))


def _cut(hosts: TwoHosts, dice: random.Random) -> None:
    hosts.pull()
    _rest(dice, 2 * LEASE_S)
    hosts.plug()


def _freeze(hosts: TwoHosts, dice: random.Random) -> None:
    host = dice.choice(["rover", "base"])
    hosts.freeze(host)
    _rest(dice, 2 * LEASE_S)
    hosts.thaw(host)


def _freeze_all(hosts: TwoHosts, dice: random.Random) -> None:
    host = dice.choice(["rover", "base"])
    hosts.freeze_all(host)
    _rest(dice, 2 * LEASE_S)
    hosts.thaw_all(host)


def _kill_gateway(hosts: TwoHosts, dice: random.Random) -> None:
    host = dice.choice(["rover", "base"])
    hosts.kill(host)
    _rest(dice, LEASE_S)
    hosts.begin(host)


def _kill_it(hosts: TwoHosts, dice: random.Random) -> None:
    hosts.kill_mind(dice.choice(["rover", "base"]))


def _hand_back(hosts: TwoHosts, dice: random.Random) -> None:
    hosts.hand_back()  # which is refused where it is not


TROUBLES: tuple[Callable[[TwoHosts, random.Random], None], ...] = (
    *(_cut, _freeze, _freeze_all, _kill_gateway, _kill_it),
    _hand_back,
)


def _back_on_rover(hosts: TwoHosts) -> Life:
    """Wherever it is; it is handed back from base as often as that takes it again."""
    asked, said = now(), ""
    while True:
        there = next((life for life in reversed(hosts.lives()) if life.last > now() - 0.1), None)
        if there is not None and there.host == "rover":
            return there
        if there is not None:
            said = hosts.hand_back().stderr
        assert now() < asked + 60, f"it does not come back: {said}; {hosts.seen()}; {hosts.complaints()}"
        threading.Event().wait(0.2)


def _lose_rover(hosts: TwoHosts, dice: random.Random) -> Callable[[], None]:
    """Cut it off, and perhaps more; returns what undoes that."""
    how = dice.choice(["cut", "cut and frozen", "cut and all frozen", "dead"])
    hosts.pull()
    match how:
        case "cut and frozen":
            hosts.freeze("rover")
        case "cut and all frozen":
            hosts.freeze_all("rover")
        case "dead":
            hosts.kill("rover")
        case _:
            pass

    def undo() -> None:
        hosts.plug()
        if how == "dead":
            hosts.begin("rover")
        hosts.thaw_all("rover")

    return undo


def test_P71_S20_a_host_is_lost_and_what_it_had_is_back_elsewhere_with_its_state_and_never_two(
    hosts: TwoHosts,
) -> None:
    dice = random.Random(SEED)
    hosts.up("rover", 0.0)
    waited_s: list[float] = []
    for turn in range(ROUNDS):
        for trouble in dice.sample(TROUBLES, dice.randrange(3)):
            trouble(hosts, dice)
            _rest(dice, LEASE_S)
        _back_on_rover(hosts)
        known = hosts.save_after(now())
        lost_at = now()
        undo = _lose_rover(hosts, dice)
        back = hosts.up("base", lost_at)
        waited_s.append(back.first - lost_at)
        hosts.begins_with(back, known)
        _rest(dice, LEASE_S)
        undo()
        lives = hosts.lives()
        assert overlaps(lives) == [], f"round {turn}: {hosts.complaints()}"
        print(f"loss {turn + 1}: back after {waited_s[-1]:.1f} s, {len(lives)} lives so far, never two")
    waited_s.sort()
    print(f"{ROUNDS} losses, {len(hosts.lives())} lives; back after {waited_s[len(waited_s) // 2]:.1f} s (median),")
    print(f"{waited_s[-1]:.1f} s at most, with a lease of {LEASE_S:g} s; never two")
