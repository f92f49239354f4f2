"""A client's process: many threads that lock, move, give back, and now and then try what they must not."""

import contextlib
import logging
import os
import queue
import random
import threading
import time
from collections.abc import Callable, Iterable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tests.support.lock_log import Ask, Done, Held, Log, Seen, now
from trade import Container, Handle, Settings, where
from trade._context.outgoing import Claim, holding
from trade.errors import TradeError
from trade.protocol.keys import Address
from trade.protocol.messages import Token
from trade.transport.base import ChannelClosed
from trade.transport.zenoh import ZenohTransport

LEASE_S = 0.5
_WAITS_S = (0.0, 0.3, 1.0, 3.0)
_FORGED = 400


class Slow:
    """All that this process puts, held back for a while: in order, each as late as was said when it was put."""

    def __init__(self) -> None:
        self._delay_s = 0.0
        self._until = 0.0
        self._queue: queue.SimpleQueue[tuple[float, Callable[[], object]]] = queue.SimpleQueue()
        self._waiting = 0
        self._guard = threading.Lock()
        threading.Thread(target=self._run, daemon=True).start()

    def delay(self, delay_s: float, for_s: float) -> None:
        """Every message takes so much longer."""
        self._delay_s, self._until = delay_s, now() + for_s

    def cut(self, for_s: float) -> None:
        """No message leaves before then."""
        self._delay_s, self._until = float("inf"), now() + for_s

    def put(self, put: Callable[[], object]) -> None:
        with self._guard:
            at = now()
            due = min(at + self._delay_s, self._until) if at < self._until else at
            if due > at or self._waiting:
                self._waiting += 1
                self._queue.put((due, put))
                return
        put()

    def _run(self) -> None:
        while True:
            due, put = self._queue.get()
            time.sleep(max(0.0, due - now()))
            with contextlib.suppress(ChannelClosed):
                put()
            with self._guard:
                self._waiting -= 1


def _hold_back(slow: Slow) -> None:
    publish = ZenohTransport.publish

    def published(self: ZenohTransport, key: str, **how: bool) -> Any:
        return _Held(publish(self, key, **how), slow)

    ZenohTransport.publish = published  # type: ignore[method-assign,assignment]


class _Held:
    def __init__(self, publisher: Any, slow: Slow) -> None:
        self._publisher = publisher
        self._slow = slow

    def put(self, payload: bytes) -> None:
        self._slow.put(lambda: self._publisher.put(payload))

    def close(self) -> None:
        self._publisher.close()


class Zombie:
    """Shows the tokens of another boot, all numbers of them, as if it had a lock."""

    held = True
    claim = Claim()

    def __init__(self, owner: Address) -> None:
        self.owner = owner

    def tokens(self) -> Iterable[Token]:
        return [Token("another-boot", number) for number in range(1, _FORGED)]


class Client:
    """One thread of them."""

    def __init__(self, container: Container, log: Log, name: str, seed: int, ended: threading.Event) -> None:
        self._container = container
        self._log = log
        self._name = name
        self._random = random.Random(seed)
        self._ended = ended
        self._count = 0

    def run(self) -> None:
        acts = [self._lock_and_move] * 7 + [self._move_freely] * 2 + [self._move_as_a_zombie]
        while not self._ended.is_set():
            try:
                handles = self._container.services(where(name="move", group="robot"))
                if handles:
                    self._random.choice(acts)(handles)
            except TradeError:  # refused, lost, gone: as it should be
                pass
            self._ended.wait(self._random.random() * 0.1)

    def _new_hold(self, what: str) -> str:
        self._count += 1
        return f"{self._name}:{what}:{self._count}"

    def _move_freely(self, handles: list[Handle]) -> None:
        self._random.choice(handles).with_(deadline_s=2)(self._new_hold("free"))

    def _move_as_a_zombie(self, handles: list[Handle]) -> None:
        reset = holding.set((Zombie(self._container.address),))
        try:
            for handle in self._random.sample(handles, min(3, len(handles))):
                handle.with_(deadline_s=2).start(self._new_hold("zombie"))
        finally:
            holding.reset(reset)

    def _lock_and_move(self, handles: list[Handle]) -> None:
        some = self._random.sample(handles, min(len(handles), self._random.choice((1, 1, 2, 3))))
        hold = self._new_hold("lock")
        lock = self._container.lock(some, wait_s=self._random.choice(_WAITS_S), lease_s=LEASE_S)
        names = tuple(name for handle in some for name in handle.resources)
        self._log.note(Ask(t=now(), hold=hold, resources=names))
        try:
            lock.acquire()
        except TradeError as refused:
            self._log.note(Done(t=now(), hold=hold, how=type(refused).__name__))
            return
        had_t = now()
        if lock.held:  # else it was frozen since the grant, and may not have it at that moment any more
            self._log.note(Held(t=had_t, hold=hold))
        try:
            with lock.use():
                self._move(lock, some, hold)
        finally:
            how = "given back" if self._still(lock, hold) else "lost"
            lock.release()
            self._log.note(Done(t=now(), hold=hold, how=how))

    def _move(self, lock: Any, some: list[Handle], hold: str) -> None:
        for _ in range(self._random.randint(1, 4)):
            if not self._still(lock, hold):
                return
            handle = self._random.choice(some).with_(deadline_s=3)
            if self._random.random() < 0.6:
                handle.start(hold)
                self._ended.wait(self._random.choice((0.0, 0.02, 0.3)))
            else:
                handle(hold)

    def _still(self, lock: Any, hold: str) -> bool:
        before_t = now()
        held = lock.held
        if held:
            self._log.note(Seen(t=before_t, hold=hold))
        return held


def main(pipe: Connection, name: str, seed: int, folder: Path, threads: int) -> None:
    """Be some clients until the pipe says or its other end is gone."""
    logging.getLogger("trade").setLevel(logging.ERROR)
    os.environ.pop("TRADE_MUTANT", None)  # for drivers
    log, slow, ended = Log(folder, name), Slow(), threading.Event()
    _hold_back(slow)
    with Container(Settings.read(container=name)) as container:
        clients = [Client(container, log, f"{name}:{number}", seed + number, ended) for number in range(threads)]
        running = [threading.Thread(target=client.run) for client in clients]
        for thread in running:
            thread.start()
        pipe.send("ready")
        _obey(pipe, slow)
        ended.set()
        for thread in running:
            thread.join(20)


def _obey(pipe: Connection, slow: Slow) -> None:
    while True:
        try:
            what, *times = pipe.recv()
        except (EOFError, OSError):
            return
        if what == "stop":
            return
        getattr(slow, what)(*times)
