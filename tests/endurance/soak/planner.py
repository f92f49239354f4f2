"""One part of the robot is locked, moved, asked and given back, again and again: what programs of a laboratory do.

``planner.py PART``; its settings are the ordinary TRADE_ variables. Every few seconds it says as JSON what it has done,
and how long the calls since took; SIGTERM ends it. ``passer`` is a container that joins, asks around and leaves.
"""

import contextlib
import json
import math
import signal
import statistics
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Final

import trade
from trade import Constraint, Handle, HookEvent, Settings, service, where
from trade.errors import DeviceSilent, TradeError

SAYS_EVERY_S: Final = 10.0
_ASKS: Final = 25
"""Times that the state is asked for in a round: the calls whose time is taken."""
_OFFERS_EVERY: Final = 3
_SAMPLES: Final = 5
_LEGS: Final = ([0.0, 0.2, 0.0] * 2, [0.3, 0.8, 0.0, 0.0, 0.2, 0.0])


class Notes:
    """What comes and goes: registered, hooked, called, deregistered."""

    def __init__(self) -> None:
        self.heard = 0

    @service
    def tell(self) -> int:
        return self.heard

    @service
    def note(self, call: HookEvent) -> None:
        self.heard += 1


def found(of: Constraint, name: str) -> Handle:
    return trade.find(of & where(name=name), wait_s=60).with_(deadline_s=60)


class Part:
    """What is moved, from one place to another."""

    def __init__(self, group: str, here: Sequence[float], there: Sequence[float]) -> None:
        self.of = where(group=group)
        joints = self.of & where(kind="JointGroup")
        self._move, self._enable, self.state = (found(joints, name) for name in ("move_to", "enable", "state"))
        self._places = here, there

    def act(self) -> None:
        self._enable()
        for place in self._places:
            self._move([*place])


class Arm:
    """An arm with a controller of its own, which goes between the poses of its file."""

    def __init__(self, group: str) -> None:
        self.of = where(group=group)
        names = ("power_on", "release_brakes", "move_to_pose", "state")
        self._power_on, self._release_brakes, self._move_to_pose, self.state = (found(self.of, name) for name in names)

    def act(self) -> None:
        self._power_on()
        self._release_brakes()
        for pose in ("home", "wave"):
            self._move_to_pose(pose)


class Hand:
    """A gripper."""

    def __init__(self, group: str) -> None:
        self.of = where(group=group)
        names = ("activate", "open", "close", "state")
        self._activate, self._open, self._close, self.state = (found(self.of, name) for name in names)

    def act(self) -> None:
        if not self.state().activated:  # at first, and after a stop while it could not be heard
            self._activate()
        self._close()
        self._open()


GROUPS: Final = {
    "head": "head",
    "legs": "legs",
    "tail": "tail",
    "right_arm": "right.arm",
    "left_arm": "left.arm",
    "hand": "left.hand",
}
"""Of rosie, by the name of a part."""
PARTS: Final[dict[str, Callable[[str], "Part | Arm | Hand"]]] = {
    "head": lambda group: Part(group, [0.3, 0.1], [-0.3, -0.1]),
    "legs": lambda group: Part(group, *_LEGS),
    "tail": lambda group: Part(group, [0.3, 0.2], [-0.3, -0.2]),
    "right_arm": lambda group: Part(group, [0.2, -0.3, 0.2, 0.1, 0.0, 0.2], [0.0] * 6),
    "left_arm": Arm,
    "hand": Hand,
}


class Planner:
    """Uses one part, in rounds; what it did is counted."""

    def __init__(self, name: str, part: "Part | Arm | Hand") -> None:
        self._name = name
        self._part = part
        self._asked_us: list[float] = []
        self._counts, self._errors = Counter[str](), Counter[str]()
        self._round = 0
        self._said = time.monotonic()

    def run(self, ended: threading.Event) -> None:
        while not ended.is_set():
            self._round += 1
            try:
                self._once()
            except TradeError as error:
                self._errors[f"{type(error).__name__}: {error}"] += 1
                ended.wait(1.0)
            if time.monotonic() - self._said > SAYS_EVERY_S:
                self._say()
        self._say()

    def _once(self) -> None:
        with trade.lock(self._part.of, purpose="a soak", wait_s=30):
            self._counts["locks"] += 1
            self._part.act()
        with trade.stream(self._part.state, hz=20) as samples:
            for _ in range(_SAMPLES):
                samples.next(10)
                self._counts["samples"] += 1
        for _ in range(_ASKS):
            began_s = time.perf_counter()
            self._part.state()
            self._asked_us.append((time.perf_counter() - began_s) * 1e6)
        if self._round % _OFFERS_EVERY == 0:
            self._instrumented()
        self._counts["rounds"] += 1

    def _instrumented(self) -> None:
        """Offer something of one's own for a moment, with a hook before it and a notification."""
        notes = Notes()
        trade.register(notes, f"lab.{self._name}")
        mine = where(group=f"lab.{self._name}")
        try:
            tell, note = (trade.find(mine & where(name=name)) for name in ("tell", "note"))
            hook, notification = trade.before_service(tell, note), trade.every(0.05, tell)
            try:
                self._counts["hooked calls"] += tell()
            finally:
                notification.cancel()
                hook.detach()
        finally:
            trade.deregister(notes)
        self._counts["registrations"] += 1

    def _say(self) -> None:
        asked_us = sorted(self._asked_us)
        reported: dict[str, Any] = {"counts": dict(self._counts), "errors": dict(self._errors)}
        if asked_us:
            reported["p50_us"] = statistics.median(asked_us)
            reported["p99_us"] = asked_us[math.ceil(0.99 * len(asked_us)) - 1]
        print(json.dumps(reported), flush=True)
        self._asked_us.clear()
        self._said = time.monotonic()


def pass_by() -> None:
    """Come, look around, ask what there is to ask, go."""
    trade.find(where(group="rosie.head", name="state"), wait_s=30)
    for handle in trade.services(where(name="state", group="rosie")):
        with contextlib.suppress(DeviceSilent):  # of which the planners tell
            handle()
    print(json.dumps({"knew": len(trade.services(where()))}), flush=True)


def main(part: str) -> None:
    with trade.start(Settings.read(container="passer" if part == "passer" else f"planner-{part}")):
        if part == "passer":
            pass_by()
            return
        ended = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: ended.set())
        Planner(part, PARTS[part](f"rosie.{GROUPS[part]}")).run(ended)


if __name__ == "__main__":
    main(sys.argv[1])
