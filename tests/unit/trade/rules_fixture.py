"""Rules of a file that a test writes, and a desk that hears what they call."""

import queue
from pathlib import Path
from typing import Any

from trade import Container, Handle, service
from trade.rules import Firing, Rules

SOON_S = 0.02
"""How long the rules of tests wait between looks."""


class Lamp:
    """Comes and goes."""

    @service
    def switch(self) -> None: ...


class Desk:
    """Hears what rules call, and answers their conditions."""

    def __init__(self) -> None:
        self.heard: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.wanted = False
        self.cpu = 0.1
        self.asked = 0

    @service
    def tell(self, what: Handle, word: str = "") -> str:
        self.heard.put((what.label, word))
        return "noted"

    @service
    def note(self, word: str) -> None:
        self.heard.put(word)

    @service
    def fail(self) -> None:
        raise OSError("no ink")

    @service(effect="read")
    def is_wanted(self) -> bool:
        self.asked += 1
        return self.wanted

    @service(effect="read")
    def strain(self) -> dict[str, float]:
        self.asked += 1
        return {"cpu": self.cpu}

    def next(self) -> Any:
        return self.heard.get(timeout=20)


class Engine:
    """Rules of a file that the test writes, and their firings as they come."""

    def __init__(self, container: Container, folder: Path) -> None:
        self._container = container
        self.file = folder / "rules.toml"
        self.audit = folder / "audit.jsonl"
        self._reported: queue.SimpleQueue[Firing] = queue.SimpleQueue()
        self.running: Rules | None = None

    def __call__(self, text: str, *, dry_run: bool = False) -> Rules:
        self.file.write_text(text)
        self.running = Rules(self._container, self.file, audit=self.audit, dry_run=dry_run, callback=self._reported.put)
        return self.running

    def next(self) -> Firing:
        return self._reported.get(timeout=20)


TELL = 'do = [{ call = { name = "tell" }, args = ["$service", "$container"] }]'
NOTE = 'do = [{ call = { name = "note" }, args = ["x"] }]'
