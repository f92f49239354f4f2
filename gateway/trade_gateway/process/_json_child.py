"""A child process that prints JSON: started, read line by line, killed, frozen and resumed."""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from trade.command_output import last_line
from trade.errors import TradeError

_END_S: Final = 20.0


@dataclass(kw_only=True, eq=False)
class ChildFailed(TradeError):
    """A child process does not start, has ended, or reports an error."""

    problem: str

    def describe(self) -> str:
        return self.problem


class JsonChild:
    """``python -m WORDS`` as a child process that prints one JSON object per line.

    Args:
        name: the name of the process in messages.
        words: module and arguments.
        environment: all environment variables of the process.
        complaints: the file for its standard error.
    """

    def __init__(self, name: str, words: Sequence[str], environment: Mapping[str, str], complaints: Path) -> None:
        self.name = name
        self._complaints = complaints
        with complaints.open("ab") as errors:
            self._process = subprocess.Popen(  # noqa: S603 - our own modules
                [sys.executable, "-m", *words],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env=dict(environment),
                start_new_session=True,  # Ctrl-C is for this process, which ends the others in order
            )
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, name=f"child-{name}", daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None  # noqa: S101 - a pipe
        for line in self._process.stdout:
            self._lines.put(line)
        self._lines.put(b"")

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def read_message(self, within_s: float) -> dict[str, Any]:
        """Its next message; raises ChildFailed if there is none in time, or if it reports an error."""
        try:
            line = self._lines.get(timeout=within_s)
        except queue.Empty:
            raise ChildFailed(problem=f"the {self.name} was not ready within {within_s:g} s") from None
        if not line:
            raise ChildFailed(problem=f"the {self.name} ended: {self._last_words()}")
        message: dict[str, Any] = json.loads(line)
        if "error" in message:
            raise ChildFailed(problem=f"the {self.name} says {message['error']}")
        return message

    def objection(self) -> str:
        """The error that it reports; empty if there is no message."""
        if self._lines.empty():
            return ""
        try:
            self.read_message(0.0)
        except ChildFailed as failed:
            return failed.problem
        return ""

    def tell(self) -> None:
        """Sends its next cue: a line."""
        assert self._process.stdin is not None  # noqa: S101 - a pipe
        try:
            self._process.stdin.write(b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise ChildFailed(problem=f"the {self.name} ended: {self._last_words()}") from None

    def kill(self) -> None:
        """Kills it with SIGKILL."""
        self._process.kill()

    def freeze(self) -> None:
        """Freezes it; its connections stay open."""
        self._process.send_signal(signal.SIGSTOP)

    def wake(self) -> None:
        """Resumes it; harmless if it is not frozen."""
        self._process.send_signal(signal.SIGCONT)

    def close(self, *, gently: bool) -> None:
        """Terminates the process, or kills it unless ``gently``, and waits for its end. Idempotent."""
        self.wake()
        if gently:
            self._process.terminate()
        else:
            self._process.kill()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(_END_S)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None and not pipe.closed:
                pipe.close()

    def _last_words(self) -> str:
        return last_line(self._complaints.read_text(encoding="utf-8", errors="replace")) or "it said nothing"


def bare_environment() -> dict[str, str]:
    """The environment without variables that would connect a container to another system."""
    return {name: value for name, value in os.environ.items() if not name.startswith("TRADE_")}
