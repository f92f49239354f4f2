"""Threads that are lent to one piece of work at a time."""

import contextvars
import threading
from collections.abc import Callable, Iterator

import pytest

from trade import Container, HookEvent, service, where
from trade._threads import thread_pool
from trade._threads.thread_pool import ThreadPool

pytestmark = pytest.mark.virtual_time

NUMBER: contextvars.ContextVar[int] = contextvars.ContextVar("NUMBER", default=0)
Eventually = Callable[[Callable[[], bool]], bool]


@pytest.fixture
def hands() -> Iterator[ThreadPool]:
    made = ThreadPool()
    yield made
    made.close()


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of threads as they are started."""
    names: list[str] = []
    start = threading.Thread.start

    def starting(self: threading.Thread) -> None:
        names.append(self.name)
        start(self)

    monkeypatch.setattr(threading.Thread, "start", starting)
    return names


def done_by(hands: ThreadPool, name: str = "work") -> tuple[int, str, int]:
    """Which thread does it, called what, and what it finds in its context."""
    said: list[tuple[int, str, int]] = []
    over = threading.Event()

    def work() -> None:
        said.append((threading.get_ident(), threading.current_thread().name, NUMBER.get()))
        NUMBER.set(7)
        over.set()

    hands.begin(work, name)
    assert over.wait(20)
    return said[0]


def idle(hands: ThreadPool) -> int:
    return len(hands._idle)


def test_one_thread_does_what_comes_one_after_the_other(
    hands: ThreadPool, started: list[str], eventually: Eventually
) -> None:
    for number in range(50):
        _, name, found = done_by(hands, f"work-{number}")
        assert (name, found) == (f"work-{number}", 0), "each by its own name, in a context of its own"
        assert eventually(lambda: idle(hands) == 1)
    assert started == ["work-0"]


def test_simultaneous_work_runs_at_once_and_few_threads_stay(hands: ThreadPool, eventually: Eventually) -> None:
    inside, leave = threading.Semaphore(0), threading.Event()

    def work() -> None:
        inside.release()
        leave.wait(60)

    for _ in range(30):
        hands.begin(work, "crowd")
    for _ in range(30):
        assert inside.acquire(timeout=20)
    leave.set()
    assert eventually(lambda: sum(thread.name == "crowd" for thread in threading.enumerate()) == 8)
    assert idle(hands) == 8


def test_what_fails_is_logged_and_harms_nothing(
    hands: ThreadPool, caplog: pytest.LogCaptureFixture, eventually: Eventually
) -> None:
    def fail() -> None:
        raise ValueError("no")

    hands.begin(fail, "work")
    assert eventually(lambda: idle(hands) == 1)
    assert "work in the thread pool failed" in caplog.text
    done_by(hands)


def test_a_thread_that_idles_too_long_ends_and_new_ones_start(
    monkeypatch: pytest.MonkeyPatch, hands: ThreadPool, eventually: Eventually
) -> None:
    monkeypatch.setattr(thread_pool, "_PATIENCE_S", 0.01)
    for _ in range(20):
        done_by(hands)
        assert eventually(lambda: not any(thread.name == "work" for thread in threading.enumerate()))
    assert idle(hands) == 0


def test_work_that_comes_as_one_gives_up_waiting_is_done(monkeypatch: pytest.MonkeyPatch, hands: ThreadPool) -> None:
    """It has been taken from those that wait, and has no work yet, when its patience ends."""
    monkeypatch.setattr(thread_pool, "_PATIENCE_S", 0.001)
    for _ in range(300):
        done_by(hands)


def test_a_closed_thread_pool_keeps_no_idle_threads(hands: ThreadPool, eventually: Eventually) -> None:
    done_by(hands)
    assert eventually(lambda: idle(hands) == 1)
    hands.close()
    done_by(hands)
    assert eventually(lambda: not any(thread.name == "work" for thread in threading.enumerate()))


class Arm:
    def __init__(self) -> None:
        self.seen = 0

    @service
    def move(self) -> None: ...

    @service(effect="read")
    def see(self, called: HookEvent) -> None:
        self.seen += 1


def test_a_hook_starts_no_thread_for_each_call(
    start_container: Callable[..., Container], started: list[str], eventually: Eventually
) -> None:
    here, arm = start_container("here"), Arm()
    here.register(arm, "rosie.arm")
    move, see = here.find(where(name="move")), here.find(where(name="see"))
    here.before_service(move, see)
    here.after_service(move, see)
    assert eventually(lambda: (move(), arm.seen > 0)[1])
    started.clear()
    for _ in range(50):
        move()
    assert arm.seen >= 100
    assert len([name for name in started if name.startswith("trade-run-")]) <= 5
