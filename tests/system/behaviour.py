"""A behaviour that locks robots, moves their joints and gives them back, without end; it notes all actions and replies.

``behaviour.py NAMESPACE NAME ADDRESS``; its first line of input says the rest as JSON: ``slot``, ``folder``,
``connect``, ``robots``, ``speed_rad_s``. Further lines are a word each and are answered: ``sees``, ``moved``,
``estops``, ``works``. The end of its input ends it.
"""

import json
import os
import sys
import threading
import time
from typing import Any

from tests.support.lock_log import Ask, Done, Held, Log, Seen
from tests.system.careless import CENTRE_COUNTS, STEP, rad
from tests.system.siege_records import Answer, Order
from trade import Container, Handle, Settings, where
from trade.errors import TradeError

_FAR_COUNTS = 200
_WAIT_S = 30.0
"""For a lock: longer than another one's can outlive whatever ends its owner."""
_DEADLINE_S = 60.0


class Behaviour:
    def __init__(self, container: Container, name: str, reported: dict[str, Any]) -> None:
        self._container = container
        self._name = name
        self._robots: list[str] = reported["robots"]
        self._slot = int(reported["slot"])
        self._speed_rad_s = float(reported["speed_rad_s"])
        self._log = Log(reported["folder"], name)
        self._over = threading.Event()
        self._count = 0
        self._rounds = 0
        self._moved = 0
        self._ready = False
        """Whether the joints are known to be enabled, and not held by a stop."""
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def sees(self) -> list[str]:
        """The robots that have anything to offer here."""
        found = self._container.services(where(kind="Motor"))
        return sorted({handle.groups[0].partition(".")[0] for handle in found})

    def moved(self) -> int:
        """How many moves have arrived."""
        return self._moved

    def estops(self) -> list[str]:
        return [known.id for known in self._container.estops()]

    def works(self) -> str:
        """What is wrong with a lock over both robots and a move of each joint; it moves by itself no more."""
        self.end()
        until, wrong = time.monotonic() + _WAIT_S, "nothing was tried"
        while wrong and time.monotonic() < until:
            self._ready = False
            wrong = self._round(["rosie", "dora"])
            self._over.wait(0.2 if wrong else 0.0)
        return wrong

    def end(self) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(0.02):
            if self._moves(self._robots):
                self._round(self._robots)

    def _moves(self, robots: list[str]) -> list[Handle]:
        """Of all joints of those robots; none unless all of them are there."""
        of = {robot: self._container.services(where(name="move_to", kind="Motor", group=robot)) for robot in robots}
        return [handle for handles in of.values() for handle in handles] if all(of.values()) else []

    def _round(self, robots: list[str]) -> str:
        """Lock, move each joint, give back; the error."""
        moves = self._moves(robots)
        if not moves:
            return f"it does not see {robots}"
        self._count += 1
        self._rounds += 1
        hold = f"{self._name}:{self._count}"
        names = tuple(sorted({name for handle in moves for name in handle.resources}))
        self._log.note(Ask(t=time.monotonic(), hold=hold, resources=names))
        lock = self._container.lock(moves, wait_s=_WAIT_S, lease_s=2)
        how = "given back"
        try:
            lock.acquire()
            had_t = time.monotonic()
            if lock.held:
                self._log.note(Held(t=had_t, hold=hold))
            with lock.use():
                for move in moves:
                    self._get_ready(moves)
                    before_t = time.monotonic()
                    if lock.held:
                        self._log.note(Seen(t=before_t, hold=hold))
                    self._move(move, hold)
        except TradeError as error:
            self._ready = False
            how = f"{type(error).__name__}: {error}"
        finally:
            lock.release()
            self._log.note(Done(t=time.monotonic(), hold=hold, how=how))
        return "" if how == "given back" else how

    def _get_ready(self, moves: list[Handle]) -> None:
        if self._ready:
            return
        for move in moves:
            self._container.resume(where(name="move_to", kind="Motor", group=move.groups[0]))
            self._container.call(where(name="enable", kind="Motor", group=move.groups[0]))
        self._ready = True

    def _move(self, move: Handle, hold: str) -> None:
        """To one side and to the other in turn, to places that are this behaviour's alone."""
        self._count += 1
        side = 1 if self._rounds % 2 else -1
        counts = CENTRE_COUNTS + side * (_FAR_COUNTS // STEP) * STEP + self._slot
        number, [resource] = f"{self._name}:{self._count}", move.resources
        self._log.note(
            Order(
                t=time.monotonic(),
                number=number,
                hold=hold,
                resource=resource,
                counts=counts,
                deadline_s=_DEADLINE_S,
            )
        )
        how = "arrived"
        try:
            move.with_(deadline_s=_DEADLINE_S)(rad(counts), self._speed_rad_s)
            self._moved += 1
        except TradeError as error:
            how = f"{type(error).__name__}: {error}"
            raise
        finally:
            self._log.note(Answer(t=time.monotonic(), number=number, how=how))


def main(name: str, address: str) -> None:
    reported = json.loads(sys.stdin.readline())
    settings = Settings.read(
        system=f"{os.environ['TRADE_SYSTEM']}-0",
        container=name,
        listen=[f"tls/{address}"],
        connect=[reported["connect"]],
    )
    with Container(settings) as container:
        behaviour = Behaviour(container, name, reported)
        for line in sys.stdin:
            print(json.dumps({"answer": getattr(behaviour, line.strip())()}), flush=True)
        behaviour.end()


if __name__ == "__main__":
    main(*sys.argv[2:])
