"""What the commands say about a running robot, as the docs show it."""

import os
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Final, NamedTuple

import psutil
import pytest

from tests.system.conftest import ROOT, Program
from tests.system.terminals import end_all_but, in_words, normalised

PAGE: Final = ROOT / "docs" / "transcript.md"
MARKS: Final = (
    "<!-- transcript: made by test_the_transcript_matches_the_behaviour -->\n",
    "<!-- end of transcript -->\n",
)
Command = Callable[..., subprocess.CompletedProcess[str]]


class Step(NamedTuple):
    """A command, and what it is good for."""

    why: str
    command: str
    """``{call}`` is the last id of a call that was shown."""
    numbers: bool = True
    """Whether numbers are shown as they are."""


STEPS: Final = (
    Step("A system of four containers comes up from one file.", "trade system up examples/system.toml"),
    Step("It is as the file says:", "trade system status examples/system.toml", numbers=False),
    Step("How busy is each?", "trade containers --load", numbers=False),
    Step("In another terminal a program begins to watch her.", "python examples/watch.py &"),
    Step("What does she offer at her head, and what does the house?", "trade services --group rosie.head"),
    Step("", "trade services --group home"),
    Step("What has been asked to happen by itself?", "trade notifications", numbers=False),
    Step("Which hooks are attached to which services?", "trade hooks"),
    Step("The same in English. What has changed since the last question?", 'trade ask "what is new?"'),
    Step("", 'trade ask "which containers are there?"'),
    Step("", 'trade ask "who can see a mug?"'),
    Step("", 'trade ask "who has the head?"'),
    Step("", 'trade ask "what would stop if lamps died?"'),
    Step("", 'trade ask "is discovery on?"'),
    Step("An order says what it would do, and waits for a yes.", 'trade ask "turn on discovery on care"'),
    Step("", 'trade ask --yes "turn on discovery on care"'),
    Step("From now on calls are noted.", "trade tracing on"),
    Step("She looks to the left, and down.", "trade call rosie.head.move_to '[0.3, -0.2]'"),
    Step("Which calls were there, and what happened in this one?", "trade trace"),
    Step("", "trade trace {call}"),
    Step("What was logged, and in which call?", "trade logs --container diary"),
    Step("What would the rules do now? Nothing is called.", "trade rules test examples/care.toml"),
    Step("They stand:", "trade rules list"),
    Step("Who may do what, by a policy?", "trade policy check planner call rosie.head --policy examples/policy.toml"),
    Step("", "trade policy check ann call rosie.head --policy examples/policy.toml"),
    Step("The lamp of the hall moves to the attic, with its brightness.", "trade migrate home.hall --to attic"),
    Step("", "trade call home.hall.level"),
    Step("", 'trade ask "what is new?"'),
    Step("The end; what was started last is ended first.", "trade system down examples/system.toml"),
)


class Terminal:
    """Runs commands as a user would, and what runs in the background."""

    def __init__(self, trade_command: Command, run: Callable[..., Program]) -> None:
        self._command = trade_command
        self._run = run
        self._call = ""

    def type(self, step: Step) -> str:
        """A step as the page has it."""
        command = step.command.format(call=self._call)
        said = normalised(self._said(command), numbers=step.numbers)
        shown = f"```console\n$ {in_words(command)}\n{said}```\n"
        return f"{step.why}\n\n{shown}\n" if step.why else f"{shown}\n"

    def _said(self, command: str) -> str:
        program, *words = shlex.split(command)
        if program == "python":
            return self._run(*words[:-1]).line()
        ended = self._command(*words)
        assert not ended.stderr, f"{command}: {ended.stderr}"
        self._call = (re.findall(r"\b\d{15,}\b", ended.stdout) or [self._call])[0]
        return ended.stdout


@pytest.fixture
def terminal(
    system: str, trade_command: Command, run: Callable[..., Program], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Terminal]:
    monkeypatch.setenv("TRADE_SYSTEM", "home")
    monkeypatch.chdir(ROOT)
    with ExitStack() as left:
        before = set(psutil.pids())
        left.callback(end_all_but, before)
        yield Terminal(trade_command, run)


def test_the_transcript_matches_the_behaviour(terminal: Terminal) -> None:
    """With WRITE_TABLES=1 in the environment it is written again."""
    reported = "\n" + "".join(terminal.type(step) for step in STEPS)
    before, mark, rest = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    shown, end, after = rest.partition(MARKS[1])
    if os.environ.get("WRITE_TABLES"):
        PAGE.write_text(before + mark + reported + end + after, encoding="utf-8")
        return
    assert reported == shown


def test_values_that_differ_between_runs_are_replaced_by_words_and_the_rest_stays() -> None:
    line = "eyes: up 12 after 3.1 s, process 4711 (call 2858444437409759234) 0.300660234425585 -0.19942 0.5\n"
    assert normalised(line) == "eyes: up 12 after TIME, process PID (call CALL) 0.3 -0.2 0.5\n"
    assert normalised("CALL  AT       LAST\na     3.4 ms\n  b   12.4 ms  no\n") == (
        "CALL  AT    LAST\na     TIME\n  b   TIME  no\n"
    )
    assert normalised("CALLS  N\nx      7\n", numbers=False) == "CALLS  N\nx      N\n"
