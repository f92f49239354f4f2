"""Runs one scene: starts a motion, causes the failure, and measures how long the motion continues."""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from trade_checks.drill._report import SceneReport, Stop
from trade_checks.drill._scenes import Scene, limit_s
from trade_checks.drill._targets import Target
from trade_checks.drill._testbed import Testbed
from trade_gateway.process._json_child import ChildFailed, JsonChild
from trade_robotfile import Drill

_TRIES: Final = 3
_BEGUN_S: Final = 20.0
_ON_ITS_WAY_S: Final = 0.5
"""Shortest time from the first motion until the failure, in seconds."""
_REST_S: Final = 12.0
"""Longest wait for a joint to rest, in seconds."""
_QUIET_S: Final = 1.0
"""A joint at rest for so long is finally at rest, in seconds."""
_LOOK_EVERY_S: Final = 0.05


class DrillFailed(ChildFailed):
    """A drill cannot run: a process or device that it needs does not start, or does not move."""


def play(stand: Testbed, scene: Scene, targets: Sequence[Target], given: Drill) -> SceneReport:
    """Runs a scene with the targets that it concerns.

    An attempt without a measurement is repeated, for example if a watchdog expires too early on a busy computer.
    A measurement is final.
    """
    concerned = [target for target in targets if scene.concerns(target)]
    problems: list[str] = []
    stops: list[Stop] = []
    while not stops and len(problems) < _TRIES:
        try:
            stops = _played(stand, scene, concerned, given)
        except ChildFailed as problem:
            problems.append(str(problem))
        finally:
            stand.dismiss()
    return SceneReport(scene=scene.name, what=scene.what, shows=scene.shows, stops=stops, problems=problems)


def _played(stand: Testbed, scene: Scene, targets: Sequence[Target], given: Drill) -> list[Stop]:
    stand.recover()
    _begin(stand, stand.call(scene, targets), targets)
    done_at = stand.strike(scene, targets)
    _wait(lambda: _quiet(stand, targets, done_at), _REST_S)
    stand.look()
    if short := [target.name for target in targets if not stand.judge.moves(target.name, at=done_at)]:
        raise DrillFailed(problem=f"{', '.join(short)} was at rest before the failure; the computer is too busy")
    rested = {
        target.name: None if stand.judge.moves(target.name) else stand.judge.rested(target.name) for target in targets
    }
    looked_until = time.monotonic()
    stand.recover()
    threading.Event().wait(_QUIET_S)
    stand.look()
    return [
        Stop(
            joint=target.name,
            bus=target.bus,
            took_s=_after(rested[target.name], done_at),
            limit_s=limit_s(scene, target, given),
            again_s=_after(stand.judge.began(target.name, looked_until), done_at),
        )
        for target in targets
    ]


def _begin(stand: Testbed, caller: JsonChild, targets: Sequence[Target]) -> None:
    """Starts the motion. Raises DrillFailed."""
    caller.tell()

    def moving() -> bool:
        if objection := caller.objection():
            raise DrillFailed(problem=objection)
        stand.look()
        return all(stand.judge.moves(target.name) for target in targets)

    if not _wait(moving, _BEGUN_S):
        still = ", ".join(target.name for target in targets if not stand.judge.moves(target.name))
        raise DrillFailed(problem=f"{still} did not begin to move within {_BEGUN_S:g} s")
    threading.Event().wait(_ON_ITS_WAY_S)


def _quiet(stand: Testbed, targets: Sequence[Target], done_at: float) -> bool:
    """Whether all of them have rested for long enough since the failure."""
    stand.look()
    if any(stand.judge.moves(target.name) for target in targets):
        return False
    return time.monotonic() - max(done_at, *(stand.judge.rested(target.name) for target in targets)) > _QUIET_S


def _wait(true: Callable[[], bool], within_s: float) -> bool:
    until, pause = time.monotonic() + within_s, threading.Event()
    while not true():
        if time.monotonic() > until:
            return False
        pause.wait(_LOOK_EVERY_S)
    return True


def _after(t: float | None, done_at: float) -> float | None:
    return None if t is None else max(0.0, t - done_at)
