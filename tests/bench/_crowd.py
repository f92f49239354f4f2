"""Containers in processes of their own on the real transport, in a network of their own: what passes between them."""

import os
import secrets
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median
from typing import Final

import psutil

from tests.bench._children import child, hear
from tests.bench._offering import fill
from tests.bench._places import own_folder
from tests.bench._report import print_target
from tests.system.networks import ip, why_not

_SYSTEM: Final = "bench-scale"
_AT_ONCE: Final = 4
"""So many begin together: each takes a second of a core."""
_SETTLE_S: Final = 20.0
"""Until those that have just begun have nothing new to tell."""
_PATIENCE_S: Final = 120.0
_LOOK_AGAIN_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Crowd:
    """What so many containers cost."""

    containers: int
    rest_bytes_s: float
    """Between all of them, whatever it is for."""
    rest_packets_s: float
    rest_cpu: float
    """Share of a core, of each."""
    join_bytes: float
    """Of one more, what passes at rest left out."""
    join_s: float
    rss_mib: float
    threads: int


def run_crowd(containers: int, simulated_join_bytes: int, seconds: float) -> None:
    """Measure and print.

    Args:
        containers: how many processes.
        simulated_join_bytes: what one joining costs that many in memory.
        seconds: how long they are looked at.
    """
    if reason := why_not():
        print(f"containers in processes: skipped, {reason}")
        return
    seen = _measure(containers, seconds)
    links = seen.containers * (seen.containers - 1) / 2
    print(f"\n{seen.containers} containers in processes of their own, {links:.0f} links")
    print(f"at rest, each      {seen.rest_bytes_s / seen.containers / 1024:8.2f} KiB/s")
    print(f"  of a link        {seen.rest_bytes_s / links:8.0f} B/s in {seen.rest_packets_s / links:.1f} packets/s")
    print(f"  processor        {100 * seen.rest_cpu:8.2f} % of a core")
    print(f"  memory           {seen.rss_mib:8.1f} MiB, {seen.threads} threads")
    print(f"one more joins     {seen.join_bytes / 1024:8.0f} KiB, all know it after {seen.join_s:.2f} s")
    ratio = seen.join_bytes / simulated_join_bytes
    print_target("join, bytes: real / simulated", [ratio], "at most 1.5", lambda share: share <= 1.5)


def _measure(containers: int, seconds: float) -> Crowd:
    with own_folder(), _network() as inside, ExitStack() as stack:

        def begin(name: str) -> Connection:
            return stack.enter_context(child(_take_part, name, inside=inside))

        members: list[Connection] = []
        pids: list[int] = []
        for number in range(containers - 1):
            members.append(begin(f"c{number}"))
            if len(members) % _AT_ONCE == 0 or number == containers - 2:
                pids += [hear(member, _PATIENCE_S) for member in members[len(pids) :]]
                print(f"scale: {len(members)} of {containers} containers", file=sys.stderr, flush=True)
        _until_known(members, containers - 1)
        time.sleep(min(_SETTLE_S, 2 * seconds))
        processes = [psutil.Process(pid) for pid in pids]
        rest_bytes_s, rest_packets_s, cpu = _at_rest(processes, seconds)
        rss = median(process.memory_info().rss for process in processes)
        before, began = _passed(pids[0]), time.monotonic()
        members.append(begin("late"))
        hear(members[-1], _PATIENCE_S)
        join_s = _until_known(members, containers)
        passed = _passed(pids[0])[0] - before[0] - rest_bytes_s * (time.monotonic() - began)
        threads = processes[0].num_threads()
    return Crowd(containers, rest_bytes_s, rest_packets_s, cpu, passed, join_s, rss / 1024**2, threads)


def _at_rest(processes: Sequence[psutil.Process], seconds: float) -> tuple[float, float, float]:
    """Bytes a second and packets a second of all together; the share of a core that each has used."""
    spent, before, began = _cpu_s(processes), _passed(processes[0].pid), time.monotonic()
    time.sleep(seconds)
    took_s = time.monotonic() - began
    passed, packets = (after - earlier for after, earlier in zip(_passed(processes[0].pid), before, strict=True))
    return passed / took_s, packets / took_s, (_cpu_s(processes) - spent) / took_s / len(processes)


def _cpu_s(processes: Sequence[psutil.Process]) -> float:
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def _passed(pid: int) -> tuple[int, int]:
    """Bytes and packets on the loopback interface of a process's network, so far."""
    lines = Path(f"/proc/{pid}/net/dev").read_text().splitlines()
    [counts] = [line.split(":")[1].split() for line in lines if line.strip().startswith("lo:")]
    return int(counts[0]), int(counts[1])


def _until_known(members: Sequence[Connection], count: int) -> float:
    """Wait until all know so many containers and what they offer; how long that was."""
    began = time.monotonic()
    for member in members:
        member.send(count)
    for member in members:
        hear(member, _PATIENCE_S)
    return time.monotonic() - began


@contextmanager
def _network() -> Iterator[str]:
    """A network namespace in which no other program is heard."""
    name = f"trade-{secrets.token_hex(3)}"
    ip("netns", "add", name)
    try:
        ip("-n", name, "link", "set", "lo", "up")
        yield name
    finally:
        ip("netns", "del", name)


def _take_part(pipe: Connection, name: str) -> None:
    from trade import Container, Settings

    with Container(Settings.read(container=name, system=_SYSTEM)) as container:
        if name != "late":
            fill(container, name)
        pipe.send(os.getpid())
        while (count := _reported(pipe)) is not None:
            _wait(lambda count=count: len(container.addresses()) == count and _complete(container.containers()))
            pipe.send("known")


def _complete(infos: Sequence[object]) -> bool:
    return all(info.services > 0 for info in infos)  # type: ignore[attr-defined]


def _reported(pipe: Connection) -> int | None:
    try:
        return pipe.recv()
    except EOFError:  # the run is over
        return None


def _wait(holds: Callable[[], bool]) -> None:
    until = time.monotonic() + _PATIENCE_S
    while not holds() and time.monotonic() < until:
        time.sleep(_LOOK_AGAIN_S)
