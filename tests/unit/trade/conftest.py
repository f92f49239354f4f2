"""Containers in pairs, and programs in processes of their own that tests talk to over pipes."""

import contextlib
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from textwrap import dedent
from typing import Any

import hypothesis
import pytest

from tests.support.two_joint_robot import Robot
from tests.support.waiting import wait_until
from tests.unit.trade.lamp_provider import Lamp, Pair, found
from tests.unit.trade.moving_providers import Scene, migration_scene
from tests.unit.trade.rules_fixture import Desk, Engine
from tests.unit.trade.stream_listeners import Battery, Two
from trade import Container, Handle, service, where
from trade._discovery.host_folder import HostFolder
from trade.protocol.keys import ALIVE, alive_key
from trade.testing import MemorySystem, memory_system
from trade.transport.base import Channel, ChannelClosed, Message
from trade.transport.credentials import user_secret
from trade.transport.endpoints import free_endpoint
from trade.transport.zenoh import ZenohTransport, configuration

hypothesis.settings.register_profile("deterministic", deadline=None, derandomize=True, max_examples=60)
hypothesis.settings.load_profile("deterministic")

_WATCHED = "import faulthandler; faulthandler.dump_traceback_later(60, exit=True)"  # a program that hangs says where
_PRELUDE = r"""
import os, sys
def say(*words): os.write(1, (" ".join(map(str, words)) + "\n").encode())
def hear(): return sys.stdin.readline().strip()
import trade
from trade import Container, Settings, service, where
"""


class Program:
    """A Python program in a child process: it says a line for each thing worth knowing and hears lines of the test."""

    def __init__(self, source: str, *arguments: str, prelude: str = _WATCHED + _PRELUDE) -> None:
        self._stderr = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed in close()
        self.process = subprocess.Popen(
            [sys.executable, "-c", prelude + dedent(source), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            text=True,
        )

    def heard(self) -> str:
        """The next line the program says."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            pytest.fail(f"the program ended with {self.process.wait()}:\n{self.errors()}")
        return line.strip()

    def tell(self, text: str = "") -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def freeze(self) -> None:
        """Stops the program, and waits until each of its threads has stopped: the signal reaches them one by one."""
        self.process.send_signal(signal.SIGSTOP)
        tasks = Path(f"/proc/{self.process.pid}/task")
        wait_until(lambda: all(" T " in (task / "stat").read_text() for task in tasks.iterdir()))

    def sleeps(self) -> bool:
        """Whether its main thread waits now."""
        return " S " in Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii")

    def thaw(self) -> None:
        self.process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def ends(self) -> int:
        """Wait for its end; returns its exit code."""
        return self.process.wait(60)

    def errors(self) -> str:
        self._stderr.seek(0)
        return self._stderr.read()

    def close(self) -> None:
        self.kill()
        for pipe in (self.process.stdin, self.process.stdout, self._stderr):
            if pipe is not None:
                pipe.close()


@pytest.fixture
def unwatched() -> str:
    """The prelude of programs that fork: a child has no watching thread, and would wait for its end."""
    return _PRELUDE


StartProgram = Callable[..., Program]


@pytest.fixture
def start_program(system: str) -> Iterator[StartProgram]:
    """Starts programs in the test's system and ends them."""
    started: list[Program] = []

    def start(source: str, *arguments: str, **options: Any) -> Program:
        started.append(Program(source, *arguments, **options))
        return started[-1]

    yield start
    for program in started:
        program.close()


@pytest.fixture
def no_local_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Containers that start from now on use the transport for all calls."""
    monkeypatch.setenv("TRADE_LOCAL_PATH", "0")


@pytest.fixture
def here(start_container: Callable[..., Container]) -> Container:
    """The container that calls."""
    return start_container("here")


@pytest.fixture
def there(start_container: Callable[..., Container]) -> Container:
    """The container that provides."""
    return start_container("there")


Offer = Callable[..., Callable[[str], Handle]]


@pytest.fixture(params=["local", "remote"])
def offer(request: pytest.FixtureRequest, here: Container) -> Offer:
    """Registers a provider in the caller's container or in another one; returns how to find its services by name."""
    host: Container = here if request.param == "local" else request.getfixturevalue("there")

    def register(provider: object, group: str = "robot", **options: Any) -> Callable[[str], Handle]:
        host.register(provider, group, **options)
        return lambda name: here.find(where(name=name, group=group), wait_s=20)

    return register


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    """What moves, from where, and where to."""
    with migration_scene(tmp_path, monkeypatch) as made:
        yield made


class Gate:
    """A provider whose service waits inside until the test lets it through."""

    def __init__(self) -> None:
        self.entered = threading.Event()
        self.open = threading.Event()
        self.runs = 0
        self.passed = 0

    @service
    def pass_through(self) -> str:
        self.runs += 1
        self.entered.set()
        self.open.wait(30)
        self.passed += 1
        return "through"


@pytest.fixture
def gate() -> Iterator[Gate]:
    """Closed until the test opens it; open at its end, so that no thread stays inside."""
    waiting = Gate()
    yield waiting
    waiting.open.set()


def eventually(holds: Callable[[], bool]) -> bool:
    """Wait until something observable holds, for as long as a test may take."""
    deadline = time.monotonic() + 30
    while not holds() and time.monotonic() < deadline:
        threading.Event().wait(0.005)
    return holds()


@pytest.fixture(name="eventually")
def _eventually() -> Callable[[Callable[[], bool]], bool]:
    return eventually


OpenRaw = Callable[..., ZenohTransport]


@pytest.fixture
def open_raw(system: str) -> Iterator[OpenRaw]:
    """Opens bare transports in the test's system, to say what no container would; each is linked when it is given."""
    with contextlib.ExitStack() as stack:

        def start(*linked: Container) -> ZenohTransport:
            rendezvous, endpoint = HostFolder(system), free_endpoint()
            stack.callback(rendezvous.leave)
            others = rendezvous.enter(endpoint)
            transport = ZenohTransport(
                configuration(namespace=system, listen=[endpoint], connect=others, credentials=user_secret())
            )
            stack.callback(transport.close)
            signs = transport.presences(ALIVE)
            awaited = {alive_key(container.address) for container in linked}
            while awaited:
                awaited.discard(signs.receive().key)
            signs.close()
            return transport

        yield start


@pytest.fixture(params=[pytest.param("zenoh", marks=pytest.mark.realtime), "memory", "one container"])
def two(request: pytest.FixtureRequest, start_container: Callable[..., Container]) -> Iterator[Two]:
    battery = Battery()
    if request.param == "memory":
        with memory_system() as system:
            two = Two(system.container("here"), system.container("there"), battery)
            two.there.register(battery, "rosie")
            yield two
        return
    here = start_container("here")
    there = here if request.param == "one container" else start_container("there")
    there.register(battery, "rosie")
    yield Two(here, there, battery)


@pytest.fixture
def apart(memory: MemorySystem) -> Two:
    """Two containers in memory."""
    battery = Battery()
    memory.container("there").register(battery, "rosie")
    return Two(memory.container("here"), memory.container("there"), battery)


@pytest.fixture
def robot() -> Iterator[Robot]:
    with memory_system() as system:
        made = Robot(system)
        yield made
        for joint in made.joints.values():
            joint.hold.set()


@pytest.fixture
def lamp() -> Lamp:
    return Lamp()


@pytest.fixture
def pair(lamp: Lamp) -> Pair:
    """A caller, a callee, and the caller's handle of the callee's lamp, called once."""

    def start(system: MemorySystem) -> tuple[Container, Container, Handle]:
        caller, callee = system.container("caller"), system.container("callee")
        callee.register(lamp, "robot")
        handle = found(caller)
        handle(0.0)
        return caller, callee, handle

    return start


@pytest.fixture
def desk(here: Container) -> Desk:
    desk = Desk()
    here.register(desk, "desk")
    return desk


@pytest.fixture
def engine(here: Container, tmp_path: Path) -> Iterator[Engine]:
    made = Engine(here, tmp_path)
    yield made
    if made.running is not None:
        made.running.close()


class QueueChannel(Channel):
    """A channel into which a test puts messages."""

    def __init__(self) -> None:
        self.waiting: queue.SimpleQueue[Message | None] = queue.SimpleQueue()

    def receive(self) -> Message:
        message = self.waiting.get(timeout=60)
        if message is None:
            self.close()
            raise ChannelClosed
        return message

    def close(self) -> None:
        self.waiting.put(None)


@pytest.fixture
def channel() -> Iterator[QueueChannel]:
    """Closed at the end of the test."""
    made = QueueChannel()
    yield made
    made.close()
