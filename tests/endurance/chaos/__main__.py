"""Locks under faults: clients and drivers in many processes are killed, frozen, cut off and delayed, all from one seed.

What each of them saw and wrote is judged at the end. Prints counts and violations; exits 1 if there is one.
TRADE_MUTANT=no-fence (geq, no-drain, no-expiry, zombie-epoch) breaks the drivers' locks: then it must exit 1.
"""

import argparse
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from tests.endurance.chaos import _client, _driver
from tests.endurance.chaos._records import AnyRecord, Fault
from tests.endurance.chaos._verify import verify
from tests.support.lock_log import Log, Verdict, now, read

_FORKS = multiprocessing.get_context("forkserver")
_FAULTS: Final = ("kill", "freeze", "delay", "cut")
_HUB_FAULTS_PER_S: Final = 0.25
_HUB_FROZEN_S: Final = 4.0
"""At most: longer than the lease of its links and the second that it has to return."""
_JOINTS: Final = 3
_READY_S: Final = 60.0
_END_S: Final = 40.0
_MOST_SHOWN: Final = 20


@dataclass
class Plan:
    """What is to be done; the same from the same seed."""

    seed: int
    seconds: float
    clients: int
    """Processes of clients."""
    threads: int
    """Clients in each."""
    drivers: int
    faults_per_s: float
    """Of each kind."""
    hub: bool
    """Whether all begin attached to a hub, which is killed and frozen, too."""


class Slot:
    """A place for a process; who is killed in it is followed by another one."""

    def __init__(self, name: str, start: Callable[[str], tuple[Any, Connection]]) -> None:
        self._name = name
        self._start = start
        self._turns = 0
        self.thaw_at: float | None = None
        self.begin()

    def begin(self) -> None:
        self._turns += 1
        self.name = f"{self._name}-{self._turns}"
        self.process, self.pipe = self._start(self.name)

    def ready(self) -> None:
        if not self.pipe.poll(_READY_S):
            raise RuntimeError(f"{self.name} did not come up")
        self.pipe.recv()

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def thaw(self) -> None:
        if self.thaw_at is not None:
            self.thaw_at = None
            self.signal(signal.SIGCONT)

    def kill(self) -> None:
        """It ends as a process does that is killed; another one takes its place."""
        self.thaw_at = None
        self.process.kill()
        self.process.join(_END_S)
        self.pipe.close()

    def tell(self, *words: object) -> None:
        try:
            self.pipe.send(words)
        except OSError:  # it has ended
            return


class Run:
    """All processes of a run."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        self._plan = plan
        self._log = Log(folder, "faults")
        self._random = random.Random(plan.seed)
        self._hubs = [Slot("hub", self._starter(_driver.be_hub, folder, 0))] if plan.hub else []
        for hub in self._hubs:
            hub.ready()
        self._drivers = [
            Slot(f"d{index}", self._starter(_driver.main, folder, _JOINTS)) for index in range(plan.drivers)
        ]
        self._clients = [
            Slot(f"c{index}", self._starter(_client.main, folder, plan.threads)) for index in range(plan.clients)
        ]

    def _starter(self, main: Callable[..., None], folder: Path, many: int) -> Callable[[str], tuple[Any, Connection]]:
        def start(name: str) -> tuple[Any, Connection]:
            ours, theirs = _FORKS.Pipe()
            seed = self._random.randrange(2**32)
            process = _FORKS.Process(target=main, args=(theirs, name, seed, folder, many), daemon=True)
            process.start()
            theirs.close()
            return process, ours

        return start

    def rage(self) -> None:
        """Do every fault of the plan at its time."""
        plan = self._plan
        count = int(plan.seconds * plan.faults_per_s)
        counts = dict.fromkeys(_FAULTS, count)
        if plan.hub:
            counts["hub"] = int(plan.seconds * _HUB_FAULTS_PER_S)
        times = sorted((self._random.random() * plan.seconds, what) for what in counts for _ in range(counts[what]))
        for slot in (*self._drivers, *self._clients):
            slot.ready()
        due, began = deque(times), now()
        while due:
            at, what = due.popleft()
            self._wait_until(began + at)
            getattr(self, f"_{what}")()
        self._wait_until(began + plan.seconds)

    def _wait_until(self, at: float) -> None:
        while True:
            frozen = [slot for slot in (*self._hubs, *self._drivers, *self._clients) if slot.thaw_at is not None]
            first = min(frozen, key=lambda slot: slot.thaw_at or 0.0, default=None)
            until = at if first is None or first.thaw_at is None else min(at, first.thaw_at)
            time.sleep(max(0.0, until - now()))
            if first is None or first.thaw_at is None or first.thaw_at > now():
                if now() >= at:
                    return
            else:
                first.thaw()

    def _any(self, drivers: float) -> Slot:
        """One that is not frozen, a driver with that probability."""
        among = self._drivers if self._random.random() < drivers else self._clients
        awake = [slot for slot in among if slot.thaw_at is None]
        return self._random.choice(awake or among)

    def _note(self, what: str, slot: Slot) -> None:
        self._log.note(Fault(t=now(), what=what, process=slot.name))

    def _kill(self) -> None:
        slot = self._any(drivers=0.15)
        self._note("kill", slot)
        slot.kill()
        slot.begin()

    def _freeze(self) -> None:
        slot = self._any(drivers=0.2)
        self._note("freeze", slot)
        longest_s = 0.8 if slot in self._drivers else 1.8
        slot.signal(signal.SIGSTOP)
        slot.thaw_at = now() + 0.1 + self._random.random() * longest_s

    def _delay(self) -> None:
        slot = self._any(drivers=0.0)
        self._note("delay", slot)
        slot.tell("delay", 0.05 + 0.35 * self._random.random(), 0.3 + self._random.random())

    def _cut(self) -> None:
        slot = self._any(drivers=0.0)
        self._note("cut", slot)
        slot.tell("cut", 0.2 + 2.3 * self._random.random())

    def _hub(self) -> None:
        [slot] = self._hubs
        self._note("hub", slot)
        if slot.thaw_at is not None or self._random.random() < 0.5:
            slot.kill()
            slot.begin()
        else:
            slot.signal(signal.SIGSTOP)
            slot.thaw_at = now() + 0.1 + self._random.random() * _HUB_FROZEN_S

    def end(self) -> None:
        """Let all processes end by themselves, clients first; one that does not is killed, and will be missed."""
        for slot in (*self._hubs, *self._drivers, *self._clients):
            slot.thaw()
        for slots in (self._clients, self._drivers, self._hubs):
            for slot in slots:
                slot.tell("stop")
            until = now() + _END_S
            for slot in slots:
                slot.process.join(max(0.1, until - now()))
                slot.kill()


def run(plan: Plan, folder: Path) -> Verdict:
    """Carry out a plan, and judge."""
    os.environ.update(TRADE_SYSTEM=f"chaos-{os.getpid()}", TRADE_RUNTIME_DIR=str(folder / "runtime"))
    logs = folder / "logs"
    logs.mkdir()
    running = Run(plan, logs)
    try:
        running.rage()
    finally:
        running.end()
    return verify(read(logs, AnyRecord))


def _print(plan: Plan, verdict: Verdict) -> None:
    print(f"{plan}")
    for name, count in sorted(verdict.counts.items()):
        print(f"  {name:24} {count:7}")
    for violation in verdict.violations[:_MOST_SHOWN]:
        print(violation)
    print(f"{len(verdict.violations)} violations (seed {plan.seed})")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.endurance.chaos", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--minutes", type=float, help="instead of seconds")
    parser.add_argument("--clients", type=int, default=4, help="processes of clients")
    parser.add_argument("--threads", type=int, default=10, help="clients in each")
    parser.add_argument("--drivers", type=int, default=2)
    parser.add_argument("--faults", type=float, default=2.6, help="of each kind, each second")
    parser.add_argument("--hub", action="store_true", help="a hub, which is killed and frozen, too")
    given = parser.parse_args()
    seconds = given.seconds if given.minutes is None else 60 * given.minutes
    plan = Plan(given.seed, seconds, given.clients, given.threads, given.drivers, given.faults, given.hub)
    multiprocessing.set_forkserver_preload(["tests.endurance.chaos._client", "tests.endurance.chaos._driver"])
    with tempfile.TemporaryDirectory(prefix="trade-chaos-") as folder:
        verdict = run(plan, Path(folder))
        if verdict.violations:  # the notes of all processes are the evidence
            kept = Path("build", f"chaos-{plan.seed}")
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(Path(folder, "logs"), kept)
            print(f"the notes of all are kept in {kept}")
    _print(plan, verdict)
    sys.exit(bool(verdict.violations))


if __name__ == "__main__":
    main()
