"""Many services as a container sees them that comes late: how soon it knows them, what they weigh, finding one.

A server registers them and waits; each round is a fresh process that joins. Everything goes through the public API.
"""

import gc
import sys
import time
import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from statistics import median
from typing import Final

import psutil

from tests.bench._alone import alone
from tests.bench._children import child, hear
from tests.bench._offering import kind_of_arm
from tests.bench._places import own_folder
from tests.bench._report import keep_point, print_target

_SYSTEM, _SERVER, _GROUP = "bench-registry", "server", "robot"
_MOST_FIND_US: Final = 20.0
_MOST_JOIN_S: Final = 1.0
_MOST_KIB: Final = 2.0
_PATIENCE_S: Final = 30.0
_REGISTERING_S: Final = 300.0


@dataclass(frozen=True, slots=True)
class Seen:
    """What one late joiner saw."""

    known: int
    join_s: float
    """Until everything was known, or until we gave up."""
    cpu_s: float
    rss_kib: float
    """Growth of the process: the container itself and what it knows."""
    python_kib: float
    """Of it what Python allocated; only where that was traced, which takes time."""
    find_us: Sequence[float]


def run(providers: int, services: int, rounds: int) -> None:
    """Measure and print.

    Args:
        providers: how many objects the server registers.
        services: how many services each has.
        rounds: how many late joiners come, one after the other.
    """
    count = providers * services
    _, few, _ = _late(1, services, rounds)
    registering_s, joiners, traced = _late(providers, services, rounds)
    own_kib = median(one.rss_kib for one in few)
    kib = [(one.rss_kib - own_kib) / max(1, count - services) for one in joiners]
    print(f"\n{count} services of {providers} providers: medians over {rounds} late joiners")
    print(f"{'registering':16}{registering_s:8.2f} s   ({1e3 * registering_s / providers:.2f} ms a provider)")
    print(f"{'joining':16}{median(one.join_s for one in joiners):8.2f} s   until everything was known")
    print(f"{'  CPU of it':16}{median(one.cpu_s for one in joiners):8.2f} s")
    print(f"{'memory':16}{own_kib / 1024:8.2f} MiB of a container that knows {services} services")
    print(f"{'  beyond that':16}{median(kib):8.2f} KiB a service")
    print(f"{'  Python of it':16}{traced.python_kib / count:8.2f} KiB a service")
    print(f"{'find':16}{median(us for one in joiners for us in one.find_us):8.0f} us, by name and group")
    seen = {
        "joining, s": [one.join_s for one in joiners],
        "CPU of it, s": [one.cpu_s for one in joiners],
        "KiB a service": kib,
        "find, us": [median(one.find_us) for one in joiners],
    }
    keep_point(f"{count} services of {providers} providers", "late joiner", rounds, seen)
    keep_point(f"{count} services of {providers} providers", "their container", 1, {"registering, s": [registering_s]})
    if missing := [count - one.known for one in joiners if one.known < count]:
        print(f"{len(missing)} of {rounds} joiners missed up to {max(missing)} services for {_PATIENCE_S:.0f} s")
    _print_targets(joiners, kib, "" if services > 1 else f"{providers} providers, ")


def _late(providers: int, services: int, rounds: int) -> tuple[float, list[Seen], Seen]:
    """How long registering took, what late joiners saw one after the other, and one whose memory was traced."""
    with own_folder(), child(_serve, providers, services) as server:
        registering_s = hear(server, _REGISTERING_S)
        joiners: list[Seen] = []
        for i in range(rounds):
            joiners.append(alone(_join, providers, services, False))
            print(f"registry of {providers}: joiner {i + 1} of {rounds}", file=sys.stderr, flush=True)
        return registering_s, joiners, alone(_join, providers, services, True)


def _print_targets(joiners: Sequence[Seen], kib: Sequence[float], of: str) -> None:
    join_s = [one.join_s for one in joiners]
    find_us = [median(one.find_us) for one in joiners]
    print_target(f"{of}late joiner: s", join_s, f"at most {_MOST_JOIN_S:.0f}", lambda s: s <= _MOST_JOIN_S)
    print_target(f"{of}remote service: KiB", kib, f"at most {_MOST_KIB:.0f}", lambda kib: kib <= _MOST_KIB)
    print_target(f"{of}find: us", find_us, f"at most {_MOST_FIND_US:.0f}", lambda us: us <= _MOST_FIND_US)


def _serve(pipe: Connection, providers: int, services: int) -> None:
    from trade import Container, Settings

    kind = kind_of_arm(services, stops=False)
    with Container(Settings.read(container=_SERVER, system=_SYSTEM)) as container:
        began = time.perf_counter()
        for i in range(providers):
            container.register(kind(), f"{_GROUP}.p{i}")
        pipe.send(time.perf_counter() - began)
        try:
            pipe.recv()
        except EOFError:  # the run is over
            return


def _join(providers: int, services: int, traced: bool) -> Seen:
    from trade import Container, Settings

    with Container(Settings.read(container="warm-up", system="bench-empty")) as other:
        other.services()
    count = providers * services
    if traced:
        tracemalloc.start()
    rss_before, python_before = _memory()
    began, spent = time.perf_counter(), time.process_time()
    with Container(Settings.read(container="late", system=_SYSTEM)) as container:
        while (known := _known(container)) < count and time.perf_counter() - began < _PATIENCE_S:
            time.sleep(0.001)
        join_s, cpu_s = time.perf_counter() - began, time.process_time() - spent
        rss, python = _memory()
        find_us = _find_us(container, providers, services) if known == count else [float("inf")]
        return Seen(known, join_s, cpu_s, (rss - rss_before) / 1024, (python - python_before) / 1024, find_us)


def _known(container) -> int:
    """How many of the server's services are known, without those every container has."""
    common = next(info.services for info in container.containers() if info.name == "late")
    return sum(info.services - common for info in container.containers() if info.name == _SERVER)


def _memory() -> tuple[int, int]:
    """Bytes of this process, and those that Python allocated if that is traced."""
    gc.collect()
    return psutil.Process().memory_info().rss, tracemalloc.get_traced_memory()[0]


def _find_us(container, providers: int, services: int) -> list[float]:
    from trade import where

    took_us: list[float] = []
    for i in range(50):
        constraint = where(name=f"move_{i % services}", group=f"{_GROUP}.p{7 * i % providers}")
        began = time.perf_counter_ns()
        container.find(constraint)
        took_us.append((time.perf_counter_ns() - began) / 1e3)
    return took_us
