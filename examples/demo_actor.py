"""Who acts in the demo: programs in processes of their own, and what they say."""

import contextlib
import json
import os
import queue
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

PATIENCE_S = 60.0
"""How long anything may take; far above what it takes."""


class DemoFailed(Exception):
    """What was shown is not what should have been."""


class Actor:
    """A program in a process of its own, and what it says."""

    def __init__(
        self, name: str, words: Sequence[str | Path], environment: Mapping[str, str], complaints: IO[str] | None = None
    ) -> None:
        self.name = name
        # A session of its own: Ctrl-C is for the demo, which ends the others in order.
        self.process = subprocess.Popen(
            [*map(str, words)],
            stdout=subprocess.PIPE,
            stderr=complaints,
            text=True,
            env={**os.environ, **environment},
            start_new_session=True,
        )
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                self._lines.put(line)
        self._lines.put("")

    def line(self) -> str:
        """The next line; raises DemoFailed: there is none."""
        try:
            line = self._lines.get(timeout=PATIENCE_S)
        except queue.Empty:
            raise DemoFailed(f"{self.name} has said nothing for {PATIENCE_S:.0f} s") from None
        if not line:
            raise DemoFailed(f"{self.name} ended too early; see the message above")
        return line

    def ready(self) -> dict[str, Any]:
        return json.loads(self.line())

    def hear(self, until: str) -> float:
        """Repeat what it says, up to a line that it must say; returns when it was said."""
        while True:
            line = self.line()
            print(f"  {line}", end="")
            if until in line:
                return time.monotonic()

    def hear_out(self) -> None:
        """Repeat what it says until it ends, which must be well."""
        with contextlib.suppress(queue.Empty):
            while line := self._lines.get(timeout=PATIENCE_S):
                print(f"  {line}", end="")
        if code := self.process.wait(PATIENCE_S):
            raise DemoFailed(f"{self.name} failed with exit code {code}")

    def close(self) -> None:
        """End it, in order if it will. Idempotent."""
        self.process.terminate()
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join(PATIENCE_S)
