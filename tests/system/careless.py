"""What every client of the siege does, whichever way it speaks: locks joints of robots, moves them, gives them back.

It is careless: it keeps moving what it has lost, and now and then moves what it never asked for. It notes all that
it did and all replies. ``quiet`` on its input ends the locking, ``works`` has it move every joint once more and answer.
"""

import json
import math
import os
import random
import sys
import threading
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from tests.support.lock_log import Ask, Done, Held, Log, Seen, now
from tests.system.siege_records import Answer, Order, of_robot
from trade import errors

ROBOTS = ("rosie", "dora")
CENTRE_COUNTS, FAR_COUNTS = 2048, 800
STEP = 8
"""Clients order positions that are theirs alone: of so many next to each other one."""
_FREELY = 0.2
_WAITS_S = (0.0, 0.3, 2.0)
_SPEEDS_RAD_S = (0.05, 0.05, 0.05, 0.5, 2.0)
_DEADLINES_S = (0.4, 0.5, 5.0, 30.0, 30.0)
_IN_THE_END_S = 25.0
_FAULTS = {
    name
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, (errors.DeviceError, errors.Stopped))
}


def rad(counts: int) -> float:
    """Where a joint is, from what its servo counts."""
    return (counts - CENTRE_COUNTS) * math.pi / 2048


class Refused(Exception):
    """A refusal, or no answer at all.

    Args:
        error: the name of why.
        text: more of it.
    """

    def __init__(self, error: str, text: str = "") -> None:
        super().__init__(f"{error}: {text}")
        self.error = error


class Careless(ABC):
    """A client; what it says, and to whom, is for those who inherit from it.

    Args:
        name: of its process, in its notes.
        reported: ``slot`` of those that exist, ``seed``, and the ``folder`` of its notes.
    """

    later_s = 0.0
    """By so much who passes an order on begins to count its deadline later."""
    feels_its_locks = True
    """Whether it can tell when it has a lock; who cannot had it when it asked for what was then done under it."""

    def __init__(self, name: str, reported: dict[str, Any]) -> None:
        self._name = name
        self._slot = int(reported["slot"])
        self.random = random.Random(reported["seed"])
        self._log = Log(reported["folder"], name)
        self.ended = threading.Event()
        self._count = 0
        self._asked: tuple[str, Sequence[str]] = ("", ())
        """The hold that was asked for last, and of which joints."""
        self._had = set[str]()
        """The hold that it asked for last, and the one that it knows it has had."""
        self._thread = threading.Thread(target=self._run_or_end)
        self.ways = [self._go]
        """How it moves a joint."""

    @abstractmethod
    def joints(self, robot: str) -> list[str]:
        """Those of a robot that it knows of: the names of their resources, which are those of their groups."""

    @abstractmethod
    def take(self, robots: Sequence[str], wait_s: float) -> Any:
        """Lock all joints of robots; returns what `give_back` wants."""

    def has(self, taken: Any) -> bool:
        """Whether it still has it, for sure."""
        return False

    @abstractmethod
    def give_back(self, taken: Any) -> None: ...

    def under(self, taken: Any) -> AbstractContextManager[Any]:
        """What it does in there, it does under that lock."""
        return nullcontext()

    @abstractmethod
    def call(self, joint: str, service: str, args: Sequence[Any], deadline_s: float, taken: Any) -> None:
        """Call a service of a joint and wait for its end; ``taken`` is None if that is done without a lock."""

    @abstractmethod
    def resume(self, joint: str) -> None:
        """Let it move again after another client's stop."""

    def _run_or_end(self) -> None:
        try:
            self._run()
        except BaseException:  # noqa: BLE001 - said, and the end
            traceback.print_exc()
            os._exit(1)  # a mistake of this script's: who has started it is to hear of it

    def _run(self) -> None:
        while not self.ended.wait(self.random.random() * 0.2):
            robots = self.random.choice([["rosie"], ["dora"], [*ROBOTS]])
            try:
                joints = [joint for robot in robots for joint in self.joints(robot)]
                if not joints:
                    continue
                if self.random.random() < _FREELY:
                    self._move(f"{self._name}:free", self.random.choice(joints), None)
                else:
                    self._lock_and_move(robots, joints)
            except Refused as no:
                self._log.note(Answer(t=now(), number="", how=f"not expected: {no.error}"))

    def _lock_and_move(self, robots: Sequence[str], joints: list[str]) -> None:
        self._count += 1
        hold = f"{self._name}:{self._count}"
        self._log.note(Ask(t=now(), hold=hold, resources=tuple(sorted(joints))))
        self._asked, self._had = (hold, joints), set()
        try:
            taken = self.take(robots, self.random.choice(_WAITS_S))
        except Refused as no:
            self._log.note(Done(t=now(), hold=hold, how=no.error))
            return
        had_t = now()
        if self.feels_its_locks and self.has(taken):  # it may have been frozen since the grant
            self._log.note(Held(t=had_t, hold=hold))
        how = "lost"
        try:
            with self.under(taken):
                for _ in range(self.random.randint(1, 3)):
                    self._still(taken, hold)
                    self._move(hold, self.random.choice(joints), taken)
        finally:
            if self._still(taken, hold) or not self.feels_its_locks:
                how = "given back"
            try:
                self.give_back(taken)
            except Refused as no:
                how = no.error
            self._log.note(Done(t=now(), hold=hold, how=how))

    def _still(self, taken: Any, hold: str) -> bool:
        before_t = now()
        if not self.has(taken):
            return False
        self._log.note(Seen(t=before_t, hold=hold))
        return True

    def _move(self, hold: str, joint: str, taken: Any) -> None:
        try:
            self.random.choice(self.ways)(hold, joint, taken)
        except Refused as no:  # noted; the next one tries again
            if no.error == "Stopped":
                self._try("resume", lambda: self.resume(joint))
            if no.error in _FAULTS:
                self._try("enable", lambda: self.call(joint, "enable", (), 10.0, taken))

    def _go(self, hold: str, joint: str, taken: Any) -> None:
        counts = CENTRE_COUNTS + self.random.randrange(-FAR_COUNTS // STEP, FAR_COUNTS // STEP) * STEP + self._slot
        deadline_s, speed_rad_s = self.random.choice(_DEADLINES_S), self.random.choice(_SPEEDS_RAD_S)
        self._go_there(hold, joint, counts, speed_rad_s, deadline_s, taken)

    def _go_there(self, hold: str, joint: str, counts: int, speed_rad_s: float, deadline_s: float, taken: Any) -> None:
        self.order(hold, joint, counts, "move_to", (rad(counts), speed_rad_s), deadline_s, taken)

    def order(
        self,
        hold: str,
        joint: str,
        counts: int,
        service: str,
        args: Sequence[float],
        deadline_s: float,
        taken: Any,
        valid_s: float = 0.0,
    ) -> None:
        """Order a motion, note that, and wait for its end."""
        self._count += 1
        number, asked = f"{self._name}:{self._count}", now()
        deadline = deadline_s + self.later_s
        self._log.note(
            Order(
                t=asked, number=number, hold=hold, resource=joint, counts=counts, deadline_s=deadline, valid_s=valid_s
            )
        )
        how = "arrived"
        try:
            self.call(joint, service, args, deadline_s, taken)
        except Refused as no:
            how = no.error
            raise
        finally:
            self._log.note(Answer(t=now(), number=number, how=how))
        if taken is not None and not self.feels_its_locks and hold == self._asked[0]:
            self._had_for(joint, asked)

    def _had_for(self, joint: str, t: float) -> None:
        """A joint moved under a lock at that time: who cannot ask knows by that. The robots' locks fall one by one."""
        hold, joints = self._asked
        robot = joint.partition(".")[0]
        part = of_robot(hold, robot)
        if part not in self._had:
            self._had.add(part)
            self._log.note(Ask(t=t, hold=part, resources=tuple(one for one in joints if one.startswith(f"{robot}."))))
            self._log.note(Held(t=t, hold=part))
        self._log.note(Seen(t=t, hold=part))

    def _try(self, what: str, do: Callable[[], None]) -> None:
        try:
            do()
        except Refused as no:  # the next one tries again
            self._log.note(Answer(t=now(), number="", how=f"{what}: {no.error}"))

    def works(self) -> list[str]:
        """What is wrong once it locks everything and moves every joint; waits for them."""
        until, wrong = now() + _IN_THE_END_S, ["nothing was tried"]
        while wrong and now() < until:
            wrong = self._move_all()
            threading.Event().wait(0.2)
        return wrong

    def _move_all(self) -> list[str]:
        try:
            joints = [joint for robot in ROBOTS for joint in self.joints(robot)]
            if len(joints) != 2 * len(ROBOTS):
                return [f"it knows {joints}"]
            taken = self.take(ROBOTS, 5.0)
            try:
                with self.under(taken):
                    for joint in joints:
                        self.resume(joint)
                        self.call(joint, "enable", (), 10.0, taken)
                        self._go_there(f"{self._name}:in the end", joint, CENTRE_COUNTS, 2.0, 20.0, taken)
            finally:
                self.give_back(taken)
        except Refused as no:
            return [str(no)]
        return []

    def serve(self) -> None:
        """Be it, until its input ends."""
        self._thread.start()
        for line in sys.stdin:
            self._quiet()
            print(json.dumps({"answer": self.works() if line.strip() == "works" else []}), flush=True)
        self._quiet()

    def _quiet(self) -> None:
        """Lock nothing any more."""
        self.ended.set()
        self._thread.join()
