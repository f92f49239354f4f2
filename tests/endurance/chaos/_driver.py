"""A driver's process: joints whose wire is a log, written through the gate as a driver writes to its bus."""

import logging
import random
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tests.endurance.chaos import _mutants
from tests.endurance.chaos._records import Beat, Byte, Command, End, Grant, Renewed
from tests.support.lock_log import Log, now
from trade import Container, Resource, Settings, current_call, permit, service
from trade._resources.lock_table import LockTable

_BYTES = 6
_BYTE_S = 0.005
_QUEUE_S = 0.08
"""How long a command may wait for the bus."""
_BEAT_S = 0.05


class Joint:
    """Takes its time before it looks at the gate, and then for every byte, as a slow bus does."""

    def __init__(self, name: str, log: Log, epoch: str, seed: int) -> None:
        self.resources = [Resource(name)]
        self._log = log
        self._epoch = epoch
        self._random = random.Random(seed)

    @service
    def move(self, hold: str) -> None:
        call, name = current_call(), self.resources[0].name
        assert call is not None
        grants = tuple(token.number for token in call.tokens if token.epoch == self._epoch)
        with permit(self.resources) as permitted:
            time.sleep(self._random.random() * _QUEUE_S)
            asked_t = now()
            permitted.gate()
            self._log.note(Command(t=asked_t, epoch=self._epoch, resource=name, hold=hold, grants=grants))
            for _ in range(_BYTES):
                self._log.note(Byte(t=now(), epoch=self._epoch, resource=name, hold=hold, command_t=asked_t))
                time.sleep(_BYTE_S)

    @service(effect="stop")
    def stop(self) -> None:
        """Nothing moves here once its calls have ended."""


def main(pipe: Connection, name: str, seed: int, folder: Path, joints: int) -> None:
    """Be a driver until the pipe says or its other end is gone."""
    logging.getLogger("trade").setLevel(logging.ERROR)  # that locks are lost is what this is about
    log = Log(folder, name)
    _record(log)
    _mutants.mutate()
    with Container(Settings.read(container=name)) as container:
        epoch = container.address.epoch
        for number in range(joints):
            container.register(Joint(f"{name}-j{number}", log, epoch, seed + number), f"robot.{name}.j{number}")
        ended = threading.Event()
        threading.Thread(target=_beat, args=(log, epoch, ended), daemon=True).start()
        pipe.send("ready")
        _until_asked(pipe)
        ended.set()


def be_hub(pipe: Connection, name: str, _seed: int, _folder: Path, _joints: int) -> None:
    """Be the hub of all until the pipe says or its other end is gone."""
    logging.getLogger("trade").setLevel(logging.ERROR)
    with Container(Settings.read(container=name, hub="serve")):
        pipe.send("ready")
        _until_asked(pipe)


def _until_asked(pipe: Connection) -> None:
    try:
        pipe.recv()
    except (EOFError, OSError):
        return


def _beat(log: Log, epoch: str, ended: threading.Event) -> None:
    while not ended.wait(_BEAT_S):
        log.note(Beat(t=now(), epoch=epoch))


def _record(log: Log) -> None:
    """Have the table's own steps written down."""
    grant, end, renew = LockTable._grant, LockTable._end, LockTable.renew

    def granting(self: Any, waiter: Any, terms: Any, asked: float) -> Any:
        granted = grant(self, waiter, terms, asked)
        number, resources = granted.token.number, granted.resources
        log.note(Grant(t=now(), epoch=self._epoch, number=number, resources=resources, lease_s=terms.lease_s))
        return granted

    def ending(self: Any, ended: Any, reason: str) -> None:
        before_t = now()
        end(self, ended, reason)
        log.note(End(t=before_t, epoch=self._epoch, number=ended.number, after_t=now()))

    def renewing(self: Any, numbers: Any, identity: str) -> list[int]:
        held = renew(self, numbers, identity)
        log.note(Renewed(t=now(), epoch=self._epoch, numbers=tuple(held)))
        return held

    patches: dict[str, Callable[..., Any]] = {"_grant": granting, "_end": ending, "renew": renewing}
    for name, patch in patches.items():
        setattr(LockTable, name, patch)
