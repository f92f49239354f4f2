"""Providers that move, from a module that both sides import, and the containers they move between."""

import contextlib
import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.support.policies import policy_text
from trade import Handle
from trade.testing import MemorySystem, memory_system

MODULE = '''
import threading
from trade import Resource, permit, service

events = []
before = {}
"""What is done before a method of any object continues, by its name."""

def now(name, *words):
    events.append(" ".join((name, *map(str, words))))
    before.get(name, lambda: None)()

class Counter:
    state_version = 1

    def __init__(self, step: int = 1) -> None:
        now("made", step)
        self.step, self.total = step, 0

    @service
    def count(self) -> int:
        now("count")
        self.total += self.step
        return self.total

    @service(effect="read")
    def shown(self) -> int:
        return self.total

    def save_state(self):
        now("save")
        return {"total": self.total}

    def restore_state(self, state) -> None:
        now("restore", state["total"])
        self.total = state["total"]

    def close(self) -> None:
        now("close", self.total)

class Forgetful:
    @service
    def greet(self) -> str:
        return "hello"

class Odd(Counter):
    def save_state(self):
        return object()

class Wheel:
    relocatable = True

    def __init__(self) -> None:
        now("made")
        self.resources = (Resource("wheel"),)

    @service
    def turn(self) -> None:
        with permit(self.resources) as allowed:
            allowed.gate()
            self.resources[0].moving = True

    @service(effect="stop")
    def stop(self) -> None:
        self.resources[0].moving = False

    def save_state(self):
        return None

    def restore_state(self, state) -> None:
        pass

    def close(self) -> None:
        now("close")

class Bolted(Wheel):
    relocatable = False
'''

POLICY = policy_text(
    "chief=chief old=member new=member dash=member",
    chief="administer=hall call=* read=*",
    member="register=hall call=* read=*",
)


def imported(folder: Path, text: str = MODULE) -> ModuleType:
    """The module as its text is now; objects of classes from before stay what they are."""
    (folder / "migrants_there.py").write_text(text)
    importlib.invalidate_caches()
    sys.modules.pop("migrants_there", None)
    sys.dont_write_bytecode, kept = True, sys.dont_write_bytecode
    try:
        return importlib.import_module("migrants_there")
    finally:
        sys.dont_write_bytecode = kept


class Scene:
    """Three containers: ``old``, where providers are, ``new``, where they go, and ``asker``, who has them moved."""

    def __init__(self, folder: Path, memory: MemorySystem) -> None:
        self.folder = folder
        self.memory = memory
        self.module: Any = imported(folder)
        self.old = memory.container("old", identity="old", instantiable=["migrants_there:*"])
        self.new = memory.container("new", identity="new", instantiable=["migrants_there:*"])
        self.asker = memory.container("asker", identity="chief")
        memory.settle()

    def offer(self, provider: object, *groups: str, meta: dict[str, Any] | None = None) -> dict[str, Handle]:
        """Have ``old`` offer it; returns its services by name, as the asker has them."""
        keys = [one.key for one in self.old.register(provider, groups or ("hall",), meta=meta)]
        self.memory.settle()
        self.module.events.clear()
        return {key.name: self.asker.handle(key) for key in keys}

    def counter(self, *groups: str, meta: dict[str, Any] | None = None) -> tuple[Handle, Handle]:
        """Have it offer something that has counted to three; services ``count`` and ``shown``."""
        services = self.offer(self.module.Counter(), *groups, meta=meta)
        for _ in range(3):
            services["count"]()
        self.module.events.clear()
        return services["count"], services["shown"]

    def policy(self, *, load: bool = True, **instead: str) -> Path:
        """Write `POLICY`, with these roles for these identities instead, and have all three go by it."""
        path, text = self.folder / "policy.toml", POLICY
        for who, role in instead.items():
            text = re.sub(rf"^{who} = .*$", f'{who} = ["{role}"]', text, flags=re.MULTILINE)
        path.write_text(text)
        for container in (self.old, self.new, self.asker) if load else ():
            container.load_policy(path)
        return path


@contextlib.contextmanager
def migration_scene(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    monkeypatch.syspath_prepend(folder)
    with memory_system() as memory:
        yield Scene(folder, memory)
    sys.modules.pop("migrants_there", None)
