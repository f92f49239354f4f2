"""Containers in processes of their own on the real transport, in a network of their own: what passes between them."""

import os
import secrets
import sys
import time
from collections.abc import Iterator, Sequence
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
from tests.bench._report import keep_point, print_skipped, print_target
from tests.system.networks import ip, why_not

_SYSTEM: Final = "bench-scale"
_AT_ONCE: Final = 4
"""So many begin together: each takes a second of a core."""
_SETTLE_S: Final = 20.0
"""Until those that have just begun have nothing new to tell."""
_PATIENCE_S: Final = 120.0
_HUB: Final = "hub"


@dataclass(frozen=True, slots=True)
class Crowd:
    """What so many containers cost."""

    containers: int
    rest_bytes_s: float
    """Between all of them, whatever it is for."""
    rest_packets_s: float
    rest_cpu: float
    """Share of a core, of each."""
    hub_cpu: float
    """Share of a core, of the hub, which is none of them; 0 without."""
    join_bytes: float
    """Of one more, what passes at rest left out."""
    join_s: float
    rss_mib: float
    threads: int
    open_files: tuple[int, int]
    """Of the hub, 0 without; of one of the others."""


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
    seen = _measure(containers, seconds, hub=False)
    links = seen.containers * (seen.containers - 1) / 2
    _print(seen, links)
    ratio = seen.join_bytes / simulated_join_bytes
    print_target("join, bytes: real / simulated", [ratio], "at most 1.5", lambda share: share <= 1.5)


def run_behind_a_hub(containers: int, seconds: float) -> None:
    """The same containers with one link each, to a hub. Measure and print.

    Args:
        containers: how many processes, without the hub.
        seconds: how long they are looked at.
    """
    if reason := why_not():
        print_skipped("containers behind a hub", reason)
        return
    seen = _measure(containers, seconds, hub=True)
    _print(seen, seen.containers)
    print(f"the hub takes      {100 * seen.hub_cpu:8.2f} % of a core")
    values = {
        "% of a core": [100 * seen.rest_cpu],
        "% of a core, hub": [100 * seen.hub_cpu],
        "open files": [float(seen.open_files[1])],
        "open files, hub": [float(seen.open_files[0])],
    }
    keep_point("containers behind a hub", f"{containers} containers", 1, values)
    core = 100 * seen.rest_cpu
    print_target("behind a hub: % of a core, each", [core], "at most 0.3", lambda share: share <= 0.3)
    print_target("behind a hub: a join, s", [seen.join_s], "at most 1", lambda took_s: took_s <= 1)


def _print(seen: Crowd, links: float) -> None:
    print(f"\n{seen.containers} containers in processes of their own, {links:.0f} links")
    print(f"at rest, each      {seen.rest_bytes_s / seen.containers / 1024:8.2f} KiB/s")
    print(f"  of a link        {seen.rest_bytes_s / links:8.0f} B/s in {seen.rest_packets_s / links:.1f} packets/s")
    print(f"  processor        {100 * seen.rest_cpu:8.2f} % of a core")
    print(f"  memory           {seen.rss_mib:8.1f} MiB, {seen.threads} threads, {seen.open_files[1]} open files")
    if seen.open_files[0]:
        print(f"  the hub          {seen.open_files[0]:8} open files")
    print(f"one more joins     {seen.join_bytes / 1024:8.0f} KiB, all know it {seen.join_s:.2f} s after it began")


def _measure(containers: int, seconds: float, *, hub: bool) -> Crowd:
    with own_folder(), _network() as inside, ExitStack() as stack:

        def begin(name: str) -> Connection:
            return stack.enter_context(child(_take_part, name, inside=inside))

        members: list[Connection] = []
        pids: list[int] = []
        hubs = [psutil.Process(hear(begin(_HUB), _PATIENCE_S)[0])] if hub else []
        for number in range(containers - 1):
            members.append(begin(f"c{number}"))
            if len(members) % _AT_ONCE == 0 or number == containers - 2:
                pids += [hear(member, _PATIENCE_S)[0] for member in members[len(pids) :]]
                print(f"scale: {len(members)} of {containers} containers", file=sys.stderr, flush=True)
        _until_known(members, containers - 1 + len(hubs))
        time.sleep(min(_SETTLE_S, 2 * seconds))
        processes = [psutil.Process(pid) for pid in pids]
        hub_spent_s, from_s = _cpu_s(hubs), time.monotonic()
        rest_bytes_s, rest_packets_s, cpu = _at_rest(processes, seconds)
        hub_cpu = (_cpu_s(hubs) - hub_spent_s) / (time.monotonic() - from_s)
        rss = median(process.memory_info().rss for process in processes)
        before, began = _passed(pids[0]), time.monotonic()
        members.append(begin("late"))
        _, began_to_join_s = hear(members[-1], _PATIENCE_S)
        _until_known(members, containers + len(hubs))
        join_s = time.monotonic() - began_to_join_s
        passed = _passed(pids[0])[0] - before[0] - rest_bytes_s * (time.monotonic() - began)
        threads = processes[0].num_threads()
        files = (sum(one.num_fds() for one in hubs), processes[0].num_fds())
    return Crowd(containers, rest_bytes_s, rest_packets_s, cpu, hub_cpu, passed, join_s, rss / 1024**2, threads, files)


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


def _until_known(members: Sequence[Connection], count: int) -> None:
    """Wait until all know so many containers and what they offer."""
    for member in members:
        member.send(count)
    for member in members:
        hear(member, _PATIENCE_S)


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

    began_s = time.monotonic()
    with Container(Settings.read(container=name, system=_SYSTEM, hub="serve" if name == _HUB else "auto")) as container:
        if name not in ("late", _HUB):
            fill(container, name)
        pipe.send((os.getpid(), began_s))
        registry = container._parts.registry

        def knows(count: int) -> bool:
            states = registry.containers()
            return len(states) == count and all(state.providers for state in states)

        while (count := _reported(pipe)) is not None:
            registry.wait_for(lambda count=count: knows(count), _PATIENCE_S)
            pipe.send("known")


def _reported(pipe: Connection) -> int | None:
    try:
        return pipe.recv()
    except EOFError:  # the run is over
        return None
