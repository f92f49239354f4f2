"""What every test gets: a system of its own, and a failure if it leaves a thread, file, process or loop behind."""

import asyncio
import gc
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing import resource_tracker
from pathlib import Path

import psutil
import pytest

import trade
from tests.support.tiers import tier_of
from trade import Container, Settings, where
from trade.testing import MemorySystem, memory_system

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a run in the background; what tests start would ignore it, too
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A thread that wants the interpreter asks its holder for it after this time. The default of 5 ms is too long beside
# simulated devices, which have to answer within milliseconds.
sys.setswitchinterval(0.0005)

_DESCRIPTORS = Path("/proc/self/fd")
_KERNEL_LISTS_CHILDREN = Path(f"/proc/self/task/{os.getpid()}/children").exists()
_LONGEST = ("peers/test_rust", "test_siege", "test_upgrade", "test_relocation", "soak/test_soak", "test_commissioning")
"""What takes a minute and more; a run that began with something else would end with waiting for it."""
_SETTLE_S = 15.0
"""How long what a test has ended may take to be gone; far above what it takes."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest tests."""
    items.sort(key=lambda item: not any(name in item.nodeid for name in _LONGEST))


def pytest_sessionstart() -> None:
    """The first child of `multiprocessing` brings up a process that looks after what children share, and stays."""
    resource_tracker.ensure_running()


@pytest.fixture(scope="session", autouse=True)
def _warm_up(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The transport's runtime and the event loop's selector open files once a process; that is no leak."""
    os.environ["TRADE_RUNTIME_DIR"] = str(tmp_path_factory.mktemp("runtime"))
    os.environ["XDG_CONFIG_HOME"] = str(tmp_path_factory.mktemp("config"))
    os.environ["TRADE_STATE_DIR"] = str(tmp_path_factory.mktemp("state"))
    for _ in range(2):
        with (
            Container(Settings.read(system="warm-up", container="a")) as one,
            Container(Settings.read(system="warm-up", container="b")) as other,
        ):
            other.handle(one.services(where(name="clock", container="a"))[0].key)()
    asyncio.run(asyncio.sleep(0))


@pytest.fixture(scope="module", autouse=True)
def _short_collections(_warm_up: None) -> None:
    """Leave existing objects out of garbage collections: one of all tests and reports stops threads for 0.3 s."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _nothing_leaks(_warm_up: None) -> Iterator[None]:
    threads, files, children, tasks = set(threading.enumerate()), _descriptors(), _children(), _tasks()
    yield
    trade.close()
    leaked = _wait_until_gone(
        lambda: [
            *(f"thread {thread.name}" for thread in set(threading.enumerate()) - threads if thread.is_alive()),
            *(f"file {path}" for path in _files(_descriptors() - files)),
            *(f"process {name}" for name in _children() - children),
            *(f"task {name}" for name in _tasks() - tasks),
        ]
    )
    assert not leaked, f"the test left behind: {', '.join(leaked)}"


def _wait_until_gone(leaks: Callable[[], list[str]]) -> list[str]:
    deadline = time.monotonic() + _SETTLE_S
    while (leaked := leaks()) and time.monotonic() < deadline:
        gc.collect()
        threading.Event().wait(0.02)
    return leaked


def _descriptors() -> set[str]:
    """The numbers of open files; what they stand for is read for new ones only."""
    if not _DESCRIPTORS.exists():
        return set()
    listing = os.open(os.devnull, os.O_RDONLY)  # the lowest free number, which the listing takes for itself
    os.close(listing)
    return set(os.listdir(_DESCRIPTORS)) - {str(listing)}  # noqa: PTH208 - Path is five times slower


def _files(numbers: set[str]) -> set[str]:
    found: set[str] = set()
    for number in numbers:
        try:
            target = str((_DESCRIPTORS / number).readlink())
        except OSError:  # closed meanwhile
            continue
        # Shared memory of a closed session: zenoh closes it when the next one is opened.
        if not target.removesuffix(" (deleted)").endswith(".zenoh"):
            found.add(target)
    return found


def _tasks() -> set[str]:
    """Tasks of any loop that are not done, a stopped loop's included."""
    known = getattr(asyncio.tasks, "_all_tasks", None)  # until 3.11
    known = asyncio.tasks._scheduled_tasks if known is None else known
    return {repr(task) for task in list(known) if not task.done()}


def _children() -> set[str]:
    """Processes of this process, and of those, with their command lines."""
    found: set[str] = set()
    for number in _children_numbers():
        with suppress(psutil.NoSuchProcess):
            child = psutil.Process(number)
            if child.status() != psutil.STATUS_ZOMBIE:
                found.add(f"{number} {' '.join(child.cmdline()[:4])}")
    return found


def _children_numbers() -> list[int]:
    """By the lists of the kernel, if it keeps them: to read all processes of the computer takes 3 ms."""
    if not _KERNEL_LISTS_CHILDREN:
        return [child.pid for child in psutil.Process().children(recursive=True)]
    found = [os.getpid()]
    for number in found:  # which grows
        for task in Path(f"/proc/{number}").glob("task/*/children"):
            with suppress(OSError):
                found += map(int, task.read_text().split())
    return found[1:]


@pytest.fixture(autouse=True)
def _patient_hooks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hook is cut off after 0.1 s, which a busy computer may take for any: tests of that limit are `realtime`."""
    if tier_of(request.node) == "gate":
        monkeypatch.setattr("trade._settings._HOOK_LIMIT_S", 30.0)
        monkeypatch.setitem(Settings.__init__.__kwdefaults__, "hook_limit_s", 30.0)


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A unique system id, also for child processes and for the default container."""
    name = f"test-{secrets.token_hex(4)}"
    monkeypatch.setenv("TRADE_SYSTEM", name)
    monkeypatch.setenv("TRADE_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("TRADE_STATE_DIR", str(tmp_path / "state"))
    return name


StartContainer = Callable[..., Container]


@pytest.fixture
def start_container(system: str) -> Iterator[StartContainer]:
    """Starts containers of the test's system by name and closes them."""
    started: list[Container] = []

    def start(name: str, **settings: object) -> Container:
        started.append(Container(Settings.read(container=name, **settings)))  # type: ignore[arg-type]
        return started[-1]

    yield start
    for container in reversed(started):
        container.close()


@pytest.fixture
def memory() -> Iterator[MemorySystem]:
    with memory_system() as system:
        yield system
