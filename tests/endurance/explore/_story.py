"""A story: two robots, two planners and an operator on virtual time, under troubles that a seed draws."""

import logging
import random
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Final

from tests.endurance.explore._records import Drawn
from tests.endurance.explore._stage import CLIENTS, Cast, Outcome, Stage
from tests.endurance.explore._troubles import TROUBLES
from trade.testing import virtual_time

_SWITCH: Final = 0.05
_LASTS_S: Final = 6.0
_ENDS_S: Final = 30.0
"""Every call has ended by then: deadlines, leases and stops are shorter."""

_MOST_LINES: Final = 20


def draw(seed: int) -> tuple[random.Random, Cast, list[Drawn]]:
    """The cast and the troubles of a story, in order, and the generator that draws the rest."""
    drawn = random.Random(seed)
    cast = Cast.drawn(drawn)
    ordered = sorted(_drawn(drawn, cast), key=lambda one: one.at_s)
    return drawn, cast, [one._replace(number=number) for number, one in enumerate(ordered)]


def play(seed: int, only: Sequence[int] | None = None) -> Outcome:
    """Play a story; ``only`` leaves out all of its troubles but those of these numbers."""
    drawn, cast, all_of_them = draw(seed)
    troubles = [one for one in all_of_them if only is None or one.number in only]
    outcome = Outcome(seed, cast, troubles)
    silent = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with virtual_time(seed, switch=_SWITCH, packages=["tests"]) as clock:
            _run(Stage(clock, outcome, drawn), troubles)
            outcome.elapsed_s, outcome.switches = clock.elapsed_s, clock.switches
    except Exception as failed:  # noqa: BLE001 - a deadlock, or a thread that does not end, is a finding
        said = "\n  ".join(str(failed).splitlines()[:_MOST_LINES])  # with the stack of the main thread; others follow
        outcome.violations.append(f"{type(failed).__name__}: {said}")
    finally:
        logging.disable(silent)
    return outcome


def _run(stage: Stage, troubles: Sequence[Drawn]) -> None:
    with stage.up():
        clients = [threading.Thread(target=stage.plan, args=(name,), name=name) for name in CLIENTS]
        for thread in clients:
            thread.start()
        for trouble in troubles:
            stage.clock.sleep(max(0.0, stage.began + trouble.at_s - time.monotonic()))
            stage.past.add(trouble.name)
            TROUBLES[trouble.name].do(stage, trouble.kind)
        stage.clock.sleep(max(0.0, stage.began + _LASTS_S - time.monotonic()))
        stage.over.set()
        stage.clock.stall_threads(0.0)
        for thread in clients:
            thread.join(_ENDS_S)
        stage.outcome.violations += [f"a call of {one.name} does not end" for one in clients if one.is_alive()]
        stage.judge()


def _drawn(drawn: random.Random, cast: Cast) -> Iterator[Drawn]:
    for _ in range(drawn.randrange(1, 6)):
        kind = drawn.choice(cast.robots)
        names = [name for name, trouble in TROUBLES.items() if trouble.needs(cast, kind)]
        yield Drawn(round(drawn.uniform(0.1, 0.7 * _LASTS_S), 3), drawn.choice(names), kind)
