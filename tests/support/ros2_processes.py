"""The router and other nodes of ROS 2 that the bridge is tried with, each a process of its own that can be killed."""

import json
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import zenoh

from tests.support.waiting import PATIENCE_S, wait_until
from trade_gateway.ros.ros2 import Ros2
from trade_gateway.ros.ros2._names import data_key

ROOT: Final = Path(__file__).parents[2]
DEFINITIONS: Final = ROOT / "tests" / "unit" / "ros" / "ros2" / "definitions"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Process:
    """A module of `tests.support` as a program; it ends with the test, at the latest."""

    def __init__(self, module: str, *arguments: object) -> None:
        self.reported: list[dict[str, Any]] = []
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"tests.support.{module}", *map(str, arguments)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._ready = threading.Event()
        self._reading = threading.Thread(target=self._read, name=f"reads {module}", daemon=True)
        self._reading.start()
        assert self._ready.wait(PATIENCE_S), f"{module} did not start"

    def ask(self, do: str, **arguments: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": do, **arguments}) + "\n")
        self._process.stdin.flush()

    def hear(self, what: str, **reported: object) -> dict[str, Any]:
        """Wait until it reports something; returns the report."""
        wait_until(lambda: self.has(what, **reported), f"it reports {what} {reported}; it reported {self.reported}")
        return self.has(what, **reported)[0]

    def has(self, what: str, **reported: object) -> list[dict[str, Any]]:
        wanted = {"what": what, **reported}.items()
        return [each for each in list(self.reported) if wanted <= each.items()]

    def kill(self) -> None:
        """As ``kill -9`` does. Idempotent."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.kill()
        self._process.wait()
        self._reading.join()
        self._process.stdout.close()
        with suppress(BrokenPipeError):
            self._process.stdin.close()

    close = kill

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                self.reported.append(json.loads(line))
            self._ready.set()


class Router:
    """Can be killed and started again at the same place."""

    def __init__(self, port: int) -> None:
        self._port = port
        self.endpoint: Final = f"tcp/127.0.0.1:{port}"
        self._process: Process | None = None

    def start(self) -> None:
        self._process = Process("ros2_router", self._port)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process = None


def until_heard(say: Callable[[], object], heard: Callable[[], object]) -> None:
    """A topic is heard from when both ends know of each other: until then it is said again."""

    def once() -> object:
        say()
        threading.Event().wait(0.05)
        return heard()

    wait_until(once, "it is heard")


def raw_session(router: Router) -> zenoh.Session:
    """A client at the router that knows nothing but keys and bytes."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{router.endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def until_served(session: zenoh.Session | None, key: str) -> None:
    """A service is present for a client when the router knows of it."""
    assert session is not None
    querier = session.declare_querier(key, target=zenoh.QueryTarget.ALL_COMPLETE)
    wait_until(lambda: querier.matching_status.matching, f"{key} is served")
    querier.undeclare()


def until_offered(graph: Ros2, name: str, type_name: str) -> None:
    """The same for one of our graphs."""
    until_served(graph._link.session, data_key(0, name, type_name, graph._node.hashes.service(type_name)))


@contextmanager
def closing_all() -> Iterator[Callable[[Any], Any]]:
    """Close what is handed to it, the last one first."""
    opened: list[Any] = []
    try:

        def keep(it: Any) -> Any:
            opened.append(it)
            return it

        yield keep
    finally:
        for each in reversed(opened):
            each.close()
