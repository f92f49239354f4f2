"""Children that are no processes, on a clock of the test's own: what becomes of them, against the page's own rules."""

import itertools
import math
import os
import tempfile
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hypothesis
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from tests.support.waiting import PATIENCE_S, wait_until
from trade.errors import ConfigurationError
from trade.starting import Started
from trade_gateway.config._children import Child, Supervised
from trade_gateway.config._entry import ContainerTable
from trade_gateway.supervisor import Supervisor
from trade_gateway.supervisor._objects import CreatedObjects

AFTER = {"a": (), "b": ("a",), "c": ("a", "b"), "d": ()}
GRACE_S = 20.0
QUESTION_S = 1.0
MISSES = 4
START_S = 60.0
RESTARTS, WINDOW_S = 3, 300.0
NEVER = "d"
"""The one whose table says that it is never started again."""


class Body:
    """What stands for a process: says and does what the test has it do."""

    pids = itertools.count(2**22 + 1)  # no process of Linux has one so high

    def __init__(self, name: str) -> None:
        self.name = name
        self.pid = next(self.pids)
        self.reported: list[str] = []
        self.said = self.dead = self.absent = False
        self.end, self._end = os.pipe()
        self.output, self._mouth = os.pipe()
        os.set_blocking(self.output, False)

    # what a supervisor does with it

    def read(self) -> tuple[Started | None, bool]:
        try:
            said = os.read(self.output, 100)
        except BlockingIOError:
            return None, True
        if said == b"rubbish":
            raise ValueError(said)
        return (Started(self.name, "epoch", self.pid) if said else None), bool(said)

    def terminate(self) -> None:
        self.reported.append("leave")

    def kill(self) -> None:
        self.reported.append("kill")

    def close(self) -> str:
        os.close(self.end)
        os.close(self.output)
        return "crashed (signal 11)"

    # what the test has it do

    def say(self, what: bytes) -> None:
        self.said = True
        os.write(self._mouth, what)

    def die(self) -> None:
        self.dead = True
        os.close(self._mouth)
        os.close(self._end)


class Question:
    """Whether a child answers."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self.over = False
        self._error: Exception | None = None
        self._tell: Callable[[Any], None]

    def add_done_callback(self, tell: Callable[[Any], None]) -> None:
        self._tell = tell

    def exception(self, _timeout_s: float) -> Exception | None:
        return self._error

    def end(self, error: Exception | None) -> None:
        self._error, self.over = error, True
        self._tell(self)


class Kept:
    """What the model thinks of a child."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.state = "stopped"
        self.until = math.inf
        """When something is to be done for it."""
        self.then = ""
        """What its end will mean, while it is asked to leave."""
        self.begun = self.been_up = self.leaving = self.asking = False
        self.launches = self.missed = self.absences = 0
        self.asked = -math.inf
        self.ends: list[float] = []
        self.reported: list[str] = []

    @property
    def alive(self) -> bool:
        return self.state in ("starting", "up", "silent", "stopping")


class Model(RuleBasedStateMachine):
    """What a person with the guide in hand would expect of each child; the supervisor must agree after every step."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.folder = tempfile.TemporaryDirectory()
        self.bodies: list[Body] = []
        self.questions: list[Question] = []
        self.refused: set[str] = set()
        """Those whose objects cannot be made."""
        self.no_processes = False
        self.kept: dict[str, Kept] = {}
        member: Any = SimpleNamespace(name="door", settings=SimpleNamespace(tls=None), handle=lambda key: key)
        self.real = Supervisor(
            lambda: member,
            lambda news: None,
            Path(self.folder.name),
            grace_s=GRACE_S,
            clock=lambda: self.now,
            launch=self._launched,  # type: ignore[arg-type]
            furnish=self._furnished,
        )

    def teardown(self) -> None:
        """All end, those first that others do not wait for."""
        self.no_processes = False
        closing = threading.Thread(target=self.real.close)
        closing.start()
        wait_until(lambda: self.real._closing)
        for child in self.kept.values():
            child.leaving = True
        self._settle()
        try:
            while self._alive():
                self.it_agrees(closing=True)
                reported = sorted(name for name, child in self.kept.items() if child.alive and child.reported)
                assert reported
                self._dies(reported[0])
            closing.join(PATIENCE_S)
            assert not closing.is_alive()
        finally:
            for body in self.bodies:
                if not body.dead:
                    body.die()
            closing.join(PATIENCE_S)
            self.folder.cleanup()

    def _launched(self, child: Child, *_: object) -> Body:
        if self.no_processes:
            raise BlockingIOError("no process can be had")
        assert not [body for body in self.bodies if body.name == child.name and not body.dead]  # never two at once
        self.bodies.append(Body(child.name))
        return self.bodies[-1]

    def _furnished(self, _member: object, child: Child, *_: object) -> CreatedObjects:
        if child.name in self.refused:
            raise ConfigurationError(where=child.name, problem="its object cannot be made")
        clock: Any = SimpleNamespace(with_=lambda deadline_s: clock, start=lambda: self._asked(child.name))
        clock.key = clock
        return CreatedObjects(clock, {}, [])

    def _asked(self, name: str) -> Question:
        self.questions.append(Question(self._body(name)))
        return self.questions[-1]

    def _settle(self) -> None:
        """Do whatever is to be done now."""
        while any(self._looked(name, child) for name, child in list(self.kept.items())):
            pass

    def _looked(self, name: str, child: Kept) -> bool:
        """Whether there was something to be done for one."""
        if child.leaving and not child.alive:
            del self.kept[name]
            return True
        if child.leaving and child.then != "stop" and not self._needed(name):
            self._end(child, "stop")
            return True
        if not child.begun and not child.leaving and all(self._has_been_up(other) for other in AFTER[name]):
            child.begun = True
            self._start(child)
            return True
        if child.until <= self.now:
            self._due(child)
            return True
        return False

    def _needed(self, name: str) -> bool:
        return any(name in AFTER[other] and kept.leaving and kept.alive for other, kept in self.kept.items())

    def _has_been_up(self, name: str) -> bool:
        return name in self.kept and self.kept[name].been_up

    def _start(self, child: Kept) -> None:
        child.ends.clear()
        if child.alive:
            self._end(child, "start")
        else:
            self._launch(child)

    def _launch(self, child: Kept) -> None:
        child.launches += 1
        child.state, child.until, child.then, child.reported, child.asking = (
            "starting",
            self.now + START_S,
            "",
            [],
            False,
        )
        if self.no_processes:
            self._ended(child)

    def _end(self, child: Kept, then: str) -> None:
        """It has to go; who says so last says what that means."""
        child.then = then
        if child.state != "stopping":
            child.state, child.until = "stopping", self.now + GRACE_S
            child.reported.append("leave")

    def _due(self, child: Kept) -> None:
        match child.state:
            case "waiting":
                self._launch(child)
            case "starting":
                self._end(child, "fail")
            case "stopping":
                child.reported.append("kill")
                child.until = math.inf
            case _:
                child.asking, child.asked, child.until = True, self.now, math.inf

    def _ended(self, child: Kept, *, absent: bool = False) -> None:
        then, child.until = child.then or "fail", math.inf
        child.absences = child.absences + 1 if absent and child.state == "starting" else 0
        child.then = ""
        if then == "start":
            self._launch(child)
        elif then == "stop" or child is self.kept.get(NEVER):
            child.state = "stopped"
        elif child.absences:  # no crash: without limit
            child.state, child.until = "waiting", self.now + min(30.0, 0.1 * 2 ** (child.absences - 1))
        else:
            child.ends = [*(at for at in child.ends if at > self.now - WINDOW_S), self.now]
            child.state = "waiting" if len(child.ends) <= RESTARTS else "given up"
            if child.state == "waiting":
                child.until = self.now + min(30.0, 0.1 * 2 ** (len(child.ends) - 1))

    def _named(self, data: st.DataObject, names: Iterable[str]) -> str:
        return data.draw(st.sampled_from(sorted(names)))

    def _body(self, name: str) -> Body:
        return next(body for body in reversed(self.bodies) if body.name == name)

    def _mute(self) -> list[str]:
        """Those that have a process which has said nothing yet."""
        return [name for name, child in self.kept.items() if child.alive and not self._body(name).said]

    def _alive(self) -> list[str]:
        return [name for name, child in self.kept.items() if child.alive]

    def _up(self) -> list[str]:
        return [name for name, child in self.kept.items() if child.state in ("up", "silent")]

    def _asking(self) -> list[str]:
        return [name for name in self._up() if self.kept[name].asking]

    @rule(last=st.sampled_from(["", "a", "b", "c"]), with_d=st.booleans(), version=st.sampled_from([1, 1, 1, 2]))
    def set_children(self, last: str, with_d: bool, version: int) -> None:
        """A file that names the first of three that wait for each other, and another one or not; or other words."""
        names = [*(name for name in "abc" if name <= last), *("d" if with_d else "")]
        for name, child in self.kept.items():
            child.leaving = child.leaving or name not in names
        for name in names:
            child = self.kept.setdefault(name, Kept(version))
            restarted = child.begun and (child.leaving or child.version != version)
            child.version, child.leaving = version, False
            if restarted:
                self._start(child)
        self._settle()
        self.real.set_children([_child(name, version) for name in names])

    @precondition(lambda self: self._mute())
    @rule(data=st.data(), what=st.sampled_from(["up", "up", "up", "rubbish", "its objects cannot be made"]))
    def says(self, data: st.DataObject, what: str) -> None:
        self._says(self._named(data, self._mute()), what)

    def _says(self, name: str, what: str) -> None:
        child, body = self.kept[name], self._body(name)
        (self.refused.discard if what == "up" else self.refused.add)(name)
        if child.state == "starting":
            if what == "up":
                child.state, child.been_up, child.missed, child.until = "up", True, 0, self._next_question()
                child.absences = 0
            else:
                self._end(child, "fail")
        self._settle()
        body.say(b"rubbish" if what == "rubbish" else b"up")

    def _next_question(self) -> float:
        return (math.floor(self.now / QUESTION_S) + 1) * QUESTION_S

    @precondition(lambda self: self._alive())
    @rule(data=st.data())
    def dies(self, data: st.DataObject) -> None:
        self._dies(self._named(data, self._alive()))

    @precondition(lambda self: self._alive())
    @rule(data=st.data(), times=st.integers(1, 2 * RESTARTS))
    def has_no_device(self, data: st.DataObject, times: int) -> None:
        """As often as it is started; it may be up already the first time, and only crashes then."""
        name = self._named(data, self._alive())
        for _ in range(times):
            if name in self._alive():
                self._dies(name, absent=True)
                self.it_agrees()
            if name in self.kept and self.kept[name].state == "waiting":
                self._advance(self.kept[name].until)
                self.it_agrees()

    def _dies(self, name: str, *, absent: bool = False) -> None:
        body = self._body(name)
        body.absent = absent
        self._ended(self.kept[name], absent=absent)
        self._settle()
        body.die()

    @precondition(lambda self: self._asking())
    @rule(data=st.data(), answers=st.sampled_from([True, False, False]))
    def is_asked(self, data: st.DataObject, answers: bool) -> None:
        self._is_asked(self._named(data, self._asking()), answers)

    def _is_asked(self, name: str, answers: bool) -> None:
        child = self.kept[name]
        child.asking = False
        if answers:
            child.state, child.missed, child.until = "up", 0, self._next_question()
        else:
            child.state, child.missed = "silent", child.missed + 1
            child.until = max(self.now, child.asked + QUESTION_S)
            if child.missed == MISSES:
                self._end(child, "fail")
        self._settle()
        [question] = [one for one in self.questions if one.body is self._body(name) and not one.over]
        question.end(None if answers else TimeoutError("no answer"))

    @precondition(lambda self: self._up())
    @rule(data=st.data(), times=st.sampled_from([MISSES - 1, MISSES]))
    def hangs(self, data: st.DataObject, times: int) -> None:
        """It leaves so many questions unanswered."""
        name = self._named(data, self._up())
        for _ in range(times):
            if name not in self._up():  # it is being ended: nothing of it is due at any time
                break
            if not self.kept[name].asking:
                self._advance(max(self.now, self.kept[name].until))
                self.it_agrees()
            if name in self._asking():
                self._is_asked(name, answers=False)
                self.it_agrees()

    @precondition(lambda self: self._alive())
    @rule(data=st.data(), times=st.integers(2, RESTARTS + 1))
    def dies_again_and_again(self, data: st.DataObject, times: int) -> None:
        """As often as it is started, each time as soon as that is over which it has to wait."""
        name = self._named(data, self._alive())
        for _ in range(times):
            if name in self._alive():
                self._dies(name)
                self.it_agrees()
            if name in self.kept and self.kept[name].state == "waiting":
                self._advance(self.kept[name].until)
                self.it_agrees()

    @precondition(lambda self: self._up())
    @rule(data=st.data())
    def answers_late(self, data: st.DataObject) -> None:
        """What a process was asked that is gone by now ends when the next one is up: it counts for nothing."""
        name = self._named(data, self._up())
        if not self.kept[name].asking:
            self._advance(max(self.now, self.kept[name].until))
            self.it_agrees()
        self._dies(name)
        self.it_agrees()
        if name in self.kept and self.kept[name].state == "waiting":
            self._advance(self.kept[name].until)
            self.it_agrees()
        if name in self._mute() and self.kept[name].state == "starting":
            self._says(name, "up")
            self.it_agrees()
        for question in self._late():
            question.end(TimeoutError("no answer"))

    def _late(self) -> list[Question]:
        return [question for question in self.questions if question.body.dead and not question.over]

    @precondition(lambda self: self.kept)
    @rule(data=st.data())
    def restart(self, data: st.DataObject) -> None:
        name = self._named(data, self.kept)
        child = self.kept[name]
        if not child.leaving:
            child.begun = True
            self._start(child)
        self._settle()
        assert self.real.restart(name, "anna")
        assert not self.real.restart("missing", "anna")

    @rule(duration_s=st.sampled_from([0.125, 0.25, 1.0, 1.0, 5.0, GRACE_S, START_S, WINDOW_S]))
    def advance(self, duration_s: float) -> None:
        self._advance(self.now + duration_s)

    def _advance(self, until: float) -> None:
        assert until < math.inf
        self.now = until
        self._settle()
        self.real._post(lambda: None)

    @rule()
    def processes_can_be_had_or_not(self) -> None:
        self.no_processes = not self.no_processes

    def _take_note(self) -> None:
        """The supervisor has done all that it does by itself."""
        for _ in range(2):
            for _ in range(3):
                rung = threading.Event()
                self.real._post(rung.set)
                assert rung.wait(PATIENCE_S)
            wait_until(lambda: not self.real._jobs)

    @invariant()
    def it_agrees(self, *, closing: bool = False) -> None:
        self._take_note()
        seen = {info.name: (info.state, info.restarts) for info in self.real.children()}
        thought = {name: (child.state, max(0, child.launches - 1)) for name, child in self.kept.items()}
        assert {name: seen[name] for name in thought} == thought
        assert closing or seen.keys() == thought.keys()
        with_process = {name: self._body(name).reported for name in self._alive()}
        assert with_process == {name: self.kept[name].reported for name in with_process}
        assert sorted(body.name for body in self.bodies if not body.dead) == sorted(with_process)


def _child(name: str, version: int) -> Child:
    terms = Supervised(
        providers=[],
        after=list(AFTER[name]),
        restart="never" if name == NEVER else "always",
        restarts=RESTARTS,
        window_s=WINDOW_S,
        answers_within_s=MISSES * QUESTION_S,
    )
    entry = ContainerTable(providers=[])
    part: Any = SimpleNamespace(name=name, words=("container", name, str(version)), environment={}, entry=entry)
    return Child(part, terms, {})


TestModel = Model.TestCase
TestModel.settings = hypothesis.settings(max_examples=30, stateful_step_count=40, deadline=None)


def test_what_the_process_before_was_asked_counts_for_nothing() -> None:
    model = Model()
    model.kept["a"] = Kept(1)
    model._settle()
    model.real.set_children([_child("a", 1)])
    model.it_agrees()
    for _ in range(2):
        model._says("a", "up")
        model.it_agrees()
        model._advance(model.kept["a"].until)  # it is asked
        model.it_agrees()
        for late in model._late():
            late.end(TimeoutError("no answer"))
        model.it_agrees()
        model._dies("a")
        model.it_agrees()
        model._advance(model.kept["a"].until)  # the wait is over
        model.it_agrees()
    model.teardown()
