"""Questions to all containers reach those of which only a part is known yet, and name those that do not answer."""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from trade import Container, HookEvent, LogReader, errors, service, where
from trade.testing import MemorySystem, memory_system
from trade.transport.memory import InFlightMessage, MessageKind

pytestmark = pytest.mark.virtual_time


def _no_such_hook(watcher: Container) -> None:
    with contextlib.suppress(errors.NoSuchHook):
        watcher.detach_hook("none")


def _no_such_notification(watcher: Container) -> None:
    with contextlib.suppress(errors.NoSuchNotification):
        watcher.cancel_notification("none")


_QUESTIONS: dict[str, Callable[[Container], object]] = {
    "hooks": lambda watcher: watcher.hooks(),
    "detach_hook": _no_such_hook,
    "notifications": lambda watcher: watcher.notifications(),
    "cancel_notification": _no_such_notification,
    "set_tracing": lambda watcher: watcher.set_tracing(True),
    "spans": lambda watcher: watcher.spans(),
    "log_lines": lambda watcher: watcher.logs(),
    "locks": lambda watcher: watcher.locks(),
    "attach_hook": lambda watcher: watcher.after_service(where(name="plan"), where(name="see")),
}


class Planner:
    @service
    def plan(self, goal: str) -> str:
        return goal


class Observer:
    def __init__(self) -> None:
        self.seen: queue.SimpleQueue[HookEvent] = queue.SimpleQueue()

    @service(effect="read")
    def see(self, called: HookEvent) -> None:
        self.seen.put(called)


class HalfKnown:
    """A watcher that knows the planner of a robot, and nothing else of it: the robot's replies are lost."""

    def __init__(self, system: MemorySystem) -> None:
        self.watcher = system.container("watcher")
        self.observer = Observer()
        self.watcher.register(self.observer, "watcher.eye")
        self._heal = system.lose(_reply_of_the_robot)
        self.robot = system.container("robot")
        self.robot.register(Planner(), "robot.mind")
        self.plan = self.watcher.find("robot.mind.plan")
        assert self.knows_a_part()

    def knows_a_part(self) -> bool:
        return not self.watcher.services(where(group="trade", container="robot"))

    def reply_after(self, s: float) -> None:
        """The robot's replies arrive again from then on."""
        threading.Timer(s, self._heal).start()


def _reply_of_the_robot(message: InFlightMessage) -> bool:
    return message.kind is MessageKind.ANSWER and message.source == "robot"


@pytest.fixture
def half() -> Iterator[HalfKnown]:
    with memory_system() as system:
        yield HalfKnown(system)


def test_a_hook_by_a_constraint_reports_calls_of_a_container_that_is_not_known_whole(half: HalfKnown) -> None:
    half.reply_after(0.5)
    half.watcher.after_service(where(name="plan"), where(name="see"))
    half.plan("tea")
    assert half.observer.seen.get(timeout=1).service == half.plan


def test_a_hook_is_listed_and_ended_in_a_container_that_is_not_known_whole(half: HalfKnown) -> None:
    hook = half.robot.after_service(half.robot.find("robot.mind.plan"), half.robot.find("watcher.eye.see"))
    half.reply_after(0.5)
    assert [(info.container, info.id) for info in half.watcher.hooks()] == [("robot", hook.id)]
    half.watcher.detach_hook(hook.id)
    assert half.robot.hooks() == []


def test_a_hook_is_ended_in_a_container_that_is_not_known_whole(half: HalfKnown) -> None:
    hook = half.robot.after_service(half.robot.find("robot.mind.plan"), half.robot.find("watcher.eye.see"))
    half.reply_after(0.5)
    half.watcher.detach_hook(hook.id)
    assert half.robot.hooks() == []


def test_notifications_of_a_container_that_is_not_known_whole_are_listed(half: HalfKnown) -> None:
    noted = half.robot.every(3600, half.robot.find("robot.mind.plan").bind("tea"))
    half.reply_after(0.5)
    assert [(info.container, info.id) for info in half.watcher.notifications()] == [("robot", noted.id)]


def test_a_notification_of_a_container_that_is_not_known_whole_is_cancelled(half: HalfKnown) -> None:
    noted = half.robot.every(3600, half.robot.find("robot.mind.plan").bind("tea"))
    half.reply_after(0.5)
    half.watcher.cancel_notification(noted.id)
    assert not noted.active


def test_a_container_that_is_not_known_whole_is_traced(half: HalfKnown) -> None:
    half.reply_after(0.5)
    assert half.watcher.set_tracing(True) == ["robot", "watcher"]
    half.plan("tea")
    assert {span.container for span in half.watcher.spans()} == {"robot", "watcher"}


def test_spans_of_a_container_that_is_not_known_whole_are_read(half: HalfKnown) -> None:
    half.robot.set_tracing(True, container="robot")
    half.plan("tea")
    half.reply_after(0.5)
    assert "robot" in {span.container for span in half.watcher.spans()}


def test_locks_in_a_container_that_is_not_known_whole_are_listed(half: HalfKnown) -> None:
    with half.robot.lock([half.robot.find("robot.mind.plan")]):
        half.reply_after(0.5)
        assert [lock.container for lock in half.watcher.locks()] == ["robot"]


@pytest.mark.parametrize("question", _QUESTIONS)
def test_a_container_that_does_not_answer_is_named(
    half: HalfKnown, question: str, caplog: pytest.LogCaptureFixture
) -> None:
    began = time.monotonic()
    _QUESTIONS[question](half.watcher)
    took_s = time.monotonic() - began
    assert half.knows_a_part()
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warned) == 1, warned
    assert "tester/robot" in warned[0]
    assert 0.9 < took_s < 1.5


@pytest.mark.parametrize("question", _QUESTIONS)
def test_no_container_is_named_if_all_answer(half: HalfKnown, question: str, caplog: pytest.LogCaptureFixture) -> None:
    half.reply_after(0.5)
    _QUESTIONS[question](half.watcher)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_a_reader_of_logs_names_a_container_that_does_not_answer_once(
    half: HalfKnown, caplog: pytest.LogCaptureFixture
) -> None:
    reader = LogReader(half.watcher, "*")
    reader.read()
    reader.read()
    assert sum("tester/robot" in record.getMessage() for record in caplog.records) == 1


def test_a_container_that_was_not_meant_is_not_waited_for(half: HalfKnown, caplog: pytest.LogCaptureFixture) -> None:
    began = time.monotonic()
    assert half.watcher.set_tracing(True, container="watch*") == ["watcher"]
    assert time.monotonic() - began < 0.1
    assert not caplog.records


@pytest.mark.parametrize("question", _QUESTIONS)
def test_a_container_whose_reply_is_lost_is_named(question: str, caplog: pytest.LogCaptureFixture) -> None:
    with memory_system() as system:
        watcher, robot = system.container("watcher"), system.container("robot")
        watcher.register(Observer(), "watcher.eye")
        robot.register(Planner(), "robot.mind")
        watcher.find("robot.mind.plan")
        system.settle()
        system.lose(lambda message: message.source == "robot" and message.key.startswith("reply/"))
        _QUESTIONS[question](watcher)
        time.sleep(30)
        warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
        assert any("robot" in text for text in warned), warned
