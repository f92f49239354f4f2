"""Children of a supervisor in the test's process."""

import queue
from pathlib import Path
from typing import Any

import trade
from tests.support.waiting import wait_until
from trade import Container, where
from trade_gateway.config._gateway_file import read_gateway_file
from trade_gateway.supervisor import ChildInfo, News, Supervisor

MODULE = '''
import ctypes, os, signal, threading
from trade import Resource, service

class Counter:
    def __init__(self) -> None:
        self.total = 0

    @service
    def count(self) -> int:
        self.total += 1
        return self.total

    @service(effect="read")
    def shown(self) -> int:
        return self.total

    def save_state(self):
        return {"total": self.total}

    def restore_state(self, state) -> None:
        self.total = state["total"]

class Dies:
    def __init__(self) -> None:
        os._exit(3)

class Stays(Counter):
    @service
    def ignore(self) -> None:
        """SIGTERM, for the whole process, which Python itself lets no other thread than the main one do."""
        ctypes.CDLL(None).signal(signal.SIGTERM, ctypes.c_void_p(1))

class Wheel:
    def __init__(self) -> None:
        self.resources = (Resource("wheel"),)

    @service
    def turn(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...

class Loose(Wheel):
    relocatable = True

class Grows:
    @service
    def grow(self, mb: int) -> None:
        self.kept = bytearray(b"x") * (mb * 1000000)
'''
COUNTER = 'providers = [{ class = "tiny:Counter", groups = ["hall"] }]\n'


class Keeping:
    """A supervisor in this process, its children in theirs."""

    def __init__(self, folder: Path, member: Container, grace_s: float) -> None:
        self.file = folder / "gateway.toml"
        self.news: queue.SimpleQueue[News] = queue.SimpleQueue()
        self.reported: list[str] = []
        self.supervisor = Supervisor(lambda: member, self.news.put, folder / "kept", grace_s=grace_s)
        (folder / "tiny.py").write_text(MODULE)
        self.system = member.settings.system
        self.member = member

    def set_children(self, text: str) -> None:
        self.file.write_text(f'system = "{self.system}"\n{text}')
        self.supervisor.set_children(read_gateway_file(self.file).children)

    def child(self, name: str) -> ChildInfo | None:
        return next((info for info in self.supervisor.children() if info.name == name), None)

    def become(self, name: str, state: str, restarts: int = 0) -> ChildInfo:
        """Wait until a child is in a state, started again so often at least."""
        found: list[ChildInfo] = []

        def is_so() -> bool:
            info = self.child(name)
            if info is None or info.state != state or info.restarts < restarts:
                return False
            found.append(info)
            return True

        wait_until(is_so, f"{name} is {state}")
        return found[0]

    def texts(self) -> list[str]:
        while not self.news.empty():
            self.reported.append(self.news.get().text)
        return self.reported


def call(name: str, *args: Any) -> Any:
    return trade.find(where(name=name, group="hall"), wait_s=30)(*args)
