"""A container on a network of its own: does what it is told on standard input, answers with a line each."""

import json
import os
import sys
from collections.abc import Callable
from typing import Any

from trade import Container, Settings, service, where

PROVIDERS = 5


class Echo:
    @service(effect="read")
    def echo(self, value: int) -> int:
        return value


class Member:
    def __init__(self, name: str, address: str) -> None:
        self.name = name
        self.address = address
        self.container: Container | None = None

    @property
    def up(self) -> Container:
        assert self.container is not None
        return self.container

    def start(self, *connect: str, turn: str = "0") -> str:
        system = f"{os.environ['TRADE_SYSTEM']}-{turn}"
        listen = [f"tcp/{self.address}:0"]
        self.container = Container(
            Settings.read(system=system, container=self.name, listen=listen, connect=connect or None)
        )
        return self.container.reach._links._door()

    def find_each_other(self) -> None:
        self.up.system.set_broadcast(True)
        self.up.system.set_discovery(True)

    def register(self) -> None:
        for number in range(PROVIDERS):
            self.up.register(Echo(), f"{self.name}.p{number}")

    def join_and_register(self, turn: str) -> None:
        self.start(turn=turn)
        self.find_each_other()
        self.register()

    def connect(self, endpoint: str) -> None:
        self.up.system.connect(endpoint)

    def sees(self, count: str) -> list[str]:
        """The echo services once there are so many; whatever there is after half a minute."""
        wanted = where(name="echo")
        self.up._registry.wait_for(lambda: len(self.up.services(wanted)) == int(count), 30)
        return [handle.label for handle in self.up.services(wanted)]

    def call_all(self) -> int:
        handles = self.up.services(where(name="echo"))
        return sum(handle(number) == number for number, handle in enumerate(handles))

    def state(self) -> dict[str, Any]:
        """For the message of a test that failed."""
        links = self.up.reach._links
        return {
            "own": links._own[:6],
            "peers": [str(peer)[:6] for peer in links._session.info.peers_zid()],
            "containers": {str(s.address): [s.alive, len(s.providers)] for s in self.up._registry._containers.values()},
            "refused": self.up.reach._refused,
        }

    def stop(self) -> None:
        self.up.close()


def main(name: str, address: str) -> None:
    member = Member(name, address)
    for line in sys.stdin:
        verb, *words = line.split()
        action: Callable[..., Any] = getattr(member, verb)
        try:
            answer: Any = {"answer": action(*words)}
        except Exception as error:  # noqa: BLE001 - whatever it was is told the test
            answer = {"error": f"{type(error).__name__}: {error}"}
        os.write(1, (json.dumps(answer) + "\n").encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
