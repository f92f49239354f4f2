"""What has no place in virtual time: each is refused at once, and the error names what was done."""

import _socket
import asyncio
import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import Process

import pytest
import zenoh

from trade import service, where
from trade.testing import VirtualTime, VirtualTimeError, memory_system, virtual_time
from trade.testing.virtual import _outside

HERE = [__name__.partition(".")[0]]


@pytest.fixture
def clock() -> Iterator[VirtualTime]:
    with virtual_time(seed=1, packages=HERE) as clock:
        yield clock


async def _child() -> None:
    await asyncio.create_subprocess_exec("true", "--version")


@pytest.mark.parametrize(
    ("said", "start"),
    [
        (r"subprocess\.run was called", lambda: subprocess.run(["true"], check=True)),
        (r"multiprocessing\.Process was called", lambda: Process(target=print)),
    ],
)
def test_a_process_is_refused_by_name(said: str, start: Callable[[], object], clock: VirtualTime) -> None:
    with pytest.raises(VirtualTimeError, match=said):
        start()


@pytest.mark.realtime  # in the other tier, its own guard refuses it first
@pytest.mark.parametrize(
    ("said", "start"),
    [
        (r"os\.posix_spawn", lambda: os.posix_spawn("/bin/true", ["true"], {})),
        (r"os\.fork", os.fork),
        ("true --version", lambda: asyncio.run(_child())),
    ],
)
def test_a_process_of_any_module_is_refused_by_name(said: str, start: Callable[[], object], clock: VirtualTime) -> None:
    with pytest.raises(VirtualTimeError, match=rf"a process was started \({said}\): virtual time has threads"):
        start()


async def _connect() -> None:
    await asyncio.open_connection("127.0.0.1", 9)


async def _connect_unix() -> None:
    await asyncio.open_unix_connection("/nowhere")


def test_a_real_socket_is_refused_by_name_and_a_virtual_one_says_that_none_listens(clock: VirtualTime) -> None:
    with (
        contextlib.closing(_socket.socket()) as real,
        pytest.raises(VirtualTimeError, match=r"a real socket was used \(to \('192\.0\.2\.1', 9\)\)"),
    ):
        real.connect(("192.0.2.1", 9))
    with pytest.raises(ConnectionRefusedError, match=r"no thread of this test listens on .*9.*no other process"):
        asyncio.run(_connect())
    with pytest.raises(VirtualTimeError, match=r"asyncio's create_unix_connection was called"):
        asyncio.run(_connect_unix())
    with pytest.raises(ConnectionRefusedError, match=r"no thread of this test listens on .*9.*no other process"):
        socket.create_connection(("127.0.0.1", 9))


def test_the_transport_of_the_network_is_refused_by_name(clock: VirtualTime) -> None:
    with pytest.raises(VirtualTimeError, match=r"zenoh\.open was called"):
        zenoh.open(zenoh.Config())


def test_a_thread_that_was_there_before_is_named() -> None:
    go, done = threading.Event(), threading.Event()
    lock: list[threading.Lock] = []

    def use() -> None:
        go.wait(30)
        try:
            with lock[0]:
                pass
        except VirtualTimeError as refused:
            said.append(str(refused))
        done.set()

    said: list[str] = []
    threading.Thread(target=use, name="the old one").start()
    named = "thread the old one ran beside main: it was there before virtual time began"
    with pytest.raises(VirtualTimeError, match=named), virtual_time(packages=HERE):
        lock.append(threading.Lock())
        go.set()
        while not done.is_set():
            pass
    assert said == [named]


def test_a_library_in_c_that_waits_is_named_with_its_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_outside, "OUTSIDE_S", 1.0)
    library = ctypes.CDLL(None)

    def wait_in_c() -> None:
        library.usleep(4_000_000)

    thread: list[threading.Thread] = []
    named = r"(?s)a caller has waited outside of virtual time for 1 s, in a library in C.*library\.usleep"
    with pytest.raises(VirtualTimeError, match=named), virtual_time(packages=HERE):
        thread.append(threading.Thread(target=wait_in_c, name="a caller"))
        thread[0].start()
        time.sleep(60)
    threading.Thread.join(thread[0], 30)


def test_work_without_a_wait_is_no_wait_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_outside, "OUTSIDE_S", 1.0)
    with virtual_time(packages=HERE) as clock:
        began_s = time.process_time()
        while time.process_time() < began_s + 1.5:
            pass
        assert clock.elapsed_s < 1.0


class Lamp:
    @service
    def shine(self) -> None:
        time.sleep(100)


def test_ctrl_c_ends_a_test_and_is_no_other_error() -> None:
    before = set(threading.enumerate())
    with pytest.raises(KeyboardInterrupt), virtual_time(packages=HERE), memory_system() as system:
        system.container("robot").register(Lamp(), "lamp")
        shine = system.container("mind").find(where(name="shine"), wait_s=5)
        threading.Timer(5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
        shine()
    for thread in set(threading.enumerate()) - before:
        threading.Thread.join(thread, 30)
    assert set(threading.enumerate()) == before
