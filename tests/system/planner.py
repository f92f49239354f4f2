"""A client of the siege that is a container: ``planner.py NAMESPACE NAME ADDRESS``; see `careless`.

Its first line of input says the rest as JSON: ``slot``, ``seed``, ``folder``, and where to ``connect``.
"""

import json
import os
import sys
from collections.abc import Generator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from tests.system.careless import Careless, Refused
from trade import Container, Handle, Lock, Settings, where
from trade.errors import TradeError


@contextmanager
def _refusals() -> Generator[None]:
    try:
        yield
    except TradeError as error:
        raise Refused(type(error).__name__, str(error)) from error


class Planner(Careless):
    def __init__(self, container: Container, name: str, reported: dict[str, Any]) -> None:
        super().__init__(name, reported)
        self._container = container

    def joints(self, robot: str) -> list[str]:
        return [name for handle in self._moves(robot) for name in handle.resources]

    def take(self, robots: Sequence[str], wait_s: float) -> Lock:
        moves = [handle for robot in robots for handle in self._moves(robot)]
        with _refusals():
            lock = self._container.lock(moves, wait_s=wait_s, lease_s=2)
            lock.acquire()
        return lock

    def has(self, taken: Lock) -> bool:
        return taken.held

    def give_back(self, taken: Lock) -> None:
        with _refusals():
            taken.release()

    def under(self, taken: Lock) -> AbstractContextManager[Any]:
        return taken.use()

    def call(self, joint: str, service: str, args: Sequence[Any], deadline_s: float, taken: Any) -> None:
        found = self._container.services(where(name=service, kind="Motor", group=joint))
        if not found:
            raise Refused("NoSuchService")
        with _refusals():
            self.random.choice(found).with_(deadline_s=deadline_s)(*args)

    def resume(self, joint: str) -> None:
        with _refusals():
            self._container.resume(where(group=joint))

    def _moves(self, robot: str) -> list[Handle]:
        return self._container.services(where(name="move_to", kind="Motor", group=robot))


def main(name: str, address: str) -> None:
    reported = json.loads(sys.stdin.readline())
    settings = Settings.read(
        system=f"{os.environ['TRADE_SYSTEM']}-0",
        container=name,
        listen=[f"tls/{address}"],
        connect=[reported["connect"]],
    )
    with Container(settings) as container:
        Planner(container, name, reported).serve()


if __name__ == "__main__":
    main(*sys.argv[2:])
