"""A client of the siege: locks joints of two robots, moves them, gives them back; notes all it did and was told.

It is careless: it goes on to move what it has lost, and now and then moves what it never asked for.

``planner.py NAMESPACE NAME ADDRESS``; its first line of input says the rest as JSON. ``quiet`` ends the locking,
``works`` moves every joint once more and answers, the end of its input ends it.
"""

import json
import math
import os
import random
import sys
import threading
import time
from typing import Any

from tests.holds import Ask, Done, Held, Log, Seen, now

from system.siege_records import Answer, Order
from trade import Container, Handle, Lock, Settings, where
from trade.errors import DeviceError, Stopped, TradeError

ROBOTS = ("rosie", "dora")
CENTRE_COUNTS, FAR_COUNTS = 2048, 800
STEP = 8
"""Planners order positions that are theirs alone: of so many next to each other one."""
_FREELY = 0.2
_WAITS_S = (0.0, 0.3, 2.0)
_SPEEDS_RAD_S = (0.05, 0.05, 0.05, 0.5, 2.0)
_DEADLINES_S = (0.5, 5.0, 30.0, 30.0)


def rad(counts: int) -> float:
    """Where a joint is, from what its servo counts."""
    return (counts - CENTRE_COUNTS) * math.pi / 2048


class Planner:
    def __init__(self, container: Container, name: str, told: dict[str, Any]) -> None:
        self._container = container
        self._name = name
        self._slot = int(told["slot"])
        self._random = random.Random(told["seed"])
        self._log = Log(told["folder"], name)
        self._quiet = threading.Event()
        self._count = 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def quiet(self) -> None:
        """Lock nothing any more."""
        self._quiet.set()
        self._thread.join()

    def works(self) -> list[str]:
        """What is wrong once it locks everything and moves every joint; waits for them."""
        until, wrong = now() + 25, ["nothing was tried"]
        while wrong and now() < until:
            wrong = self._move_all()
            time.sleep(0.2)
        return wrong

    def _move_all(self) -> list[str]:
        moves = [handle for robot in ROBOTS for handle in self._moves(robot)]
        if len(moves) != 2 * len(ROBOTS):
            return [f"it knows {[handle.label for handle in moves]}"]
        try:
            with self._container.lock(moves, wait_s=5, lease_s=2):
                for move in moves:
                    self._enable(move)
                    self._order(move, "in the end", CENTRE_COUNTS, 20.0, 2.0)
        except TradeError as error:
            return [f"{type(error).__name__}: {error}"]
        return []

    def _moves(self, robot: str) -> list[Handle]:
        return self._container.services(where(name="move_to", kind="Motor", group=robot))

    def _run(self) -> None:
        while not self._quiet.wait(self._random.random() * 0.2):
            robots = self._random.choice([["rosie"], ["dora"], [*ROBOTS]])
            moves = [handle for robot in robots for handle in self._moves(robot)]
            if not moves:
                continue
            try:
                if self._random.random() < _FREELY:
                    self._move(f"{self._name}:free", self._random.choice(moves))
                else:
                    self._lock_and_move(moves)
            except TradeError as error:
                self._log.note(Answer(t=now(), number="", how=f"not expected: {type(error).__name__}"))

    def _lock_and_move(self, moves: list[Handle]) -> None:
        self._count += 1
        hold = f"{self._name}:{self._count}"
        names = tuple(sorted({name for handle in moves for name in handle.resources}))
        self._log.note(Ask(t=now(), hold=hold, resources=names))
        lock = self._container.lock(moves, wait_s=self._random.choice(_WAITS_S), lease_s=2)
        try:
            lock.acquire()
        except TradeError as refused:
            self._log.note(Done(t=now(), hold=hold, how=type(refused).__name__))
            return
        self._log.note(Held(t=now(), hold=hold))
        try:
            with lock.use():
                for _ in range(self._random.randint(1, 3)):
                    self._still(lock, hold)
                    self._move(hold, self._random.choice(moves))
        finally:
            how = "given back" if self._still(lock, hold) else "lost"
            lock.release()
            self._log.note(Done(t=now(), hold=hold, how=how))

    def _move(self, hold: str, move: Handle) -> None:
        counts = CENTRE_COUNTS + self._random.randrange(-FAR_COUNTS // STEP, FAR_COUNTS // STEP) * STEP + self._slot
        deadline_s, speed_rad_s = self._random.choice(_DEADLINES_S), self._random.choice(_SPEEDS_RAD_S)
        try:
            self._order(move, hold, counts, deadline_s, speed_rad_s)
        except (DeviceError, Stopped):
            self._enable(move)
        except TradeError:  # noted, and for the next one to try again
            return

    def _order(self, move: Handle, hold: str, counts: int, deadline_s: float, speed_rad_s: float) -> None:
        self._count += 1
        number, asked = f"{self._name}:{self._count}", now()
        [resource] = move.resources
        self._log.note(
            Order(t=asked, number=number, hold=hold, resource=resource, counts=counts, deadline_s=deadline_s)
        )
        how = "arrived"
        try:
            move.with_(deadline_s=deadline_s)(rad(counts), speed_rad_s)
        except TradeError as error:
            how = type(error).__name__
            raise
        finally:
            self._log.note(Answer(t=now(), number=number, how=how))

    def _enable(self, move: Handle) -> None:
        try:
            self._container.call(where(name="enable", kind="Motor", group=move.groups[0]))
        except TradeError as error:  # the next one tries again
            self._log.note(Answer(t=now(), number="", how=f"enable: {type(error).__name__}"))

    def _still(self, lock: Lock, hold: str) -> bool:
        before_t = now()
        if not lock.held:
            return False
        self._log.note(Seen(t=before_t, hold=hold))
        return True


def main(name: str, address: str) -> None:
    told = json.loads(sys.stdin.readline())
    settings = Settings.read(
        system=f"{os.environ['TRADE_SYSTEM']}-0",
        container=name,
        listen=[f"tls/{address}"],
        connect=[told["connect"]],
    )
    with Container(settings) as container:
        planner = Planner(container, name, told)
        for line in sys.stdin:
            planner.quiet()
            print(json.dumps({"answer": planner.works() if line.strip() == "works" else []}), flush=True)
        planner.quiet()


if __name__ == "__main__":
    main(*sys.argv[2:])
