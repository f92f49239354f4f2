"""Many containers: what joining, leaving, announcing and finding cost, by how many there are; messages are counted.

In memory first: up to a thousand containers with a hundred services each, on the network of the tests, where every
message between two of them is seen. Of the larger systems a few are whole containers and the others stand-ins, which
say and ask the same (`_stand_in`). Then processes of their own on the real transport, as a check.
"""

import gc
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

from tests.bench._alone import alone
from tests.bench._crowd import run_crowd
from tests.bench._offering import PROVIDERS, SERVICES, fill, kind_of_arm
from tests.bench._report import print_target

SIZES: Final = (10, 30, 100, 300, 1000)
_MOST_ANSWERED: Final = 300
"""Of more containers than these, one process cannot answer for all before the one that joins repeats its query."""
_ALL_WHOLE: Final = 30
"""Up to so many all are whole containers; beyond, three."""
_FINDS, _LOCKS = 200, 20
_PATIENCE_S: Final = 1800.0
_MOST_PROCESSES: Final = 50


@dataclass(frozen=True, slots=True)
class Cost:
    """What went from one container to another."""

    messages: int
    bytes: int
    """Keys and payloads."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What a system of one size costs."""

    containers: int
    whole: int
    services: int
    """Known to each, the middleware's own included."""
    join: Cost
    leave: Cost
    register: Cost
    beat: Cost
    """Of one container, once."""
    estop: Cost | None
    """Given and cleared, where all are whole."""
    lock: Cost
    own_kib: float
    """The size of what a container that offers nothing announces about itself."""
    kib_a_service: float
    """What Python keeps of a service of another container."""
    threads: float
    """Of a whole container at rest, those of its transport left out."""
    find_us: float
    lock_us: float


def run(containers: int, seconds: float) -> None:
    """Measure and print.

    Args:
        containers: how many there are at most.
        seconds: how long those in processes of their own are looked at.
    """
    sizes = [size for size in SIZES if size < containers] + [containers]
    seen: list[Seen] = []
    for size in sizes:
        seen.append(alone(measure, size, patience_s=_PATIENCE_S))
        print(f"scale: {size} containers in memory", file=sys.stderr, flush=True)
    _print(seen)
    _print_targets(seen)
    crowd = min(containers, _MOST_PROCESSES)
    run_crowd(crowd, alone(measure, crowd, patience_s=_PATIENCE_S).join.bytes, seconds)


def _print(seen: Sequence[Seen]) -> None:
    each = PROVIDERS * SERVICES
    print(f"\ncontainers with {each} services of {PROVIDERS} providers each, simulated: messages, and KiB of them")
    print(f"{'containers':26}" + "".join(f"{one.containers:>18}" for one in seen))
    rows: dict[str, Callable[[Seen], str]] = {
        "  of them whole": lambda one: str(one.whole),
        "services known": lambda one: str(one.services),
        "one joins": lambda one: _reported(one.join),
        "one leaves": lambda one: _reported(one.leave),
        "one object registered": lambda one: _reported(one.register),
        "beat of one": lambda one: _reported(one.beat),
        "e-stop, cleared again": lambda one: _reported(one.estop),
        "lock, call, unlock": lambda one: _reported(one.lock),
        "Python, KiB a service": lambda one: f"{one.kib_a_service:.2f}",
        "threads of a container": lambda one: f"{one.threads:.1f}",
        "find, us": lambda one: f"{one.find_us:.0f}",
        "lock, call, unlock, us": lambda one: f"{one.lock_us:.0f}",
    }
    for name, tell in rows.items():
        print(f"{name:26}" + "".join(f"{tell(one):>18}" for one in seen))
    print(f"a container that offers nothing announces {seen[0].own_kib:.1f} KiB about itself")


def _reported(cost: Cost | None) -> str:
    return "" if cost is None else f"{cost.messages} / {cost.bytes / 1024:.1f}"


def _print_targets(seen: Sequence[Seen]) -> None:
    least, most = seen[0], seen[-1]
    one_answers = max((one for one in seen if one.containers <= _MOST_ANSWERED), key=lambda one: one.containers)
    bytes_each = [one.join.bytes / one.containers for one in (least, one_answers)]
    finds, locks = most.find_us / least.find_us, most.lock_us / least.lock_us
    print_target(
        f"join, bytes each: {one_answers.containers} / {least.containers}",
        [bytes_each[1] / bytes_each[0]],
        "at most 1.2",
        lambda x: x <= 1.2,
    )
    print_target("remote service: KiB of Python", [most.kib_a_service], "at most 2", lambda kib: kib <= 2)
    print_target("find: most / least", [finds], "at most 2", lambda ratio: ratio <= 2)
    print_target("lock: most / least", [locks], "at most 2", lambda ratio: ratio <= 2)


def measure(size: int, whole: int | None = None) -> Seen:
    """Build a system of that many containers, and look at the last one that joins.

    Args:
        size: how many there are when it has joined.
        whole: how many are whole containers; by default as many as there is memory for.
    """
    from tests.bench._stand_in import StandIn, offer_of
    from trade import where
    from trade.testing import memory_system

    whole = min(size, 3 if size > _ALL_WHOLE else size) if whole is None else whole
    with memory_system() as system:
        pattern = _whole(system, "c0")
        threads_one = _threads()
        offer = offer_of(pattern)
        others = [_whole(system, f"c{number}") for number in range(1, whole - 1)]
        threads = (_threads() - threads_one) / max(1, len(others)) if others else float(threads_one)
        fast = size > _ALL_WHOLE
        stand_ins = [
            StandIn(system.network, f"c{number}", _offer_as(offer, f"c{number}"), asks=not fast)
            for number in range(max(1, whole - 1), size - 1)
        ]
        _settle(system)
        for stand_in in stand_ins:
            stand_in.ask_from_now_on()
        own = [info for (domain, _), info in offer.items() if domain == "trade"]
        own_infos = [service for info in own for service in info.services]
        count = _Counting(system)
        late = system.container("late", identity="bench")
        each = len(pattern.services(_of("c0")))
        _wait(lambda: sum(info.services for info in late.containers()) == (size - 1) * each + len(own_infos))
        _settle(system)
        join = count.since()
        services = len(late.services())
        own_services = len(late.services(where(container="late")))
        taken_in = services - own_services + (whole - 1) * own_services
        fill(late, "late")
        _settle(system)
        count.since()
        late.register(kind_of_arm()(), "extra.one")
        _settle(system)
        register = count.since()
        pattern._parts.announcer._quiet = 0
        pattern._parts.announcer.beat(2)
        beat = count.since()
        estop = _estop(system, late, count) if not stand_ins else None
        find_us = _median_us(
            lambda turn: late.find(where(name=f"move_{turn % SERVICES}", group=f"robot.c0.p{turn % PROVIDERS}")), _FINDS
        )
        count.since()
        handle = late.find(where(name="move_0", group="robot.c0.p0"))

        def use(_turn: int) -> None:
            with late.lock([handle]):
                handle(0.0, 0.0, 0.0)

        use(0)
        count.since()
        use(1)
        lock = count.since()
        lock_us = _median_us(use, _LOCKS)
        count.since()
        late.close()
        _settle(system)
        leave = count.since()
        kib = _memory_kib(lambda: system.container("last", identity="bench"), system)
        for stand_in in stand_ins:
            stand_in.close()
    return Seen(
        containers=size,
        whole=whole,
        services=services,
        join=join,
        leave=leave,
        register=register,
        beat=beat,
        estop=estop,
        lock=lock,
        own_kib=_own_kib(own),
        kib_a_service=kib / max(1, taken_in),
        threads=threads,
        find_us=find_us,
        lock_us=lock_us,
    )


class _Counting:
    """What went from one container to another since it was asked last."""

    def __init__(self, system: Any) -> None:
        self._messages = self._bytes = 0
        system.tap(self._hear)

    def _hear(self, passage: Any) -> None:
        if not passage.arrived:
            self._messages += 1
            self._bytes += len(passage.key) + len(passage.payload or b"")

    def since(self) -> Cost:
        cost = Cost(self._messages, self._bytes)
        self._messages = self._bytes = 0
        return cost


def _whole(system: Any, name: str) -> Any:
    container = system.container(name, identity="bench")
    fill(container, name)
    _settle(system)
    return container


def _offer_as(offer: Any, name: str) -> Any:
    """What c0 offers, in the groups of another one."""
    from msgspec import structs

    def renamed(group: str) -> str:
        return group.replace("robot.c0.", f"robot.{name}.")

    return {
        (renamed(domain), provider): structs.replace(info, groups=tuple(map(renamed, info.groups)))
        for (domain, provider), info in offer.items()
    }


def _threads() -> int:
    """Threads of containers, in this process."""
    import threading

    return sum(thread.name.startswith("trade-") for thread in threading.enumerate())


def _estop(system: Any, caller: Any, count: _Counting) -> Cost:
    report = caller.estop("scale", limit_s=30)
    caller.estop_clear([report.id], limit_s=30)
    _settle(system)
    if not report.complete:
        raise RuntimeError(f"an e-stop was not confirmed by {report.missing}")
    return count.since()


def _memory_kib(make: Callable[[], object], system: Any) -> float:
    """What Python keeps of what is made, with what others know of it, in KiB."""
    gc.collect()
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    made = make()
    assert made is not None
    _settle(system)
    gc.collect()
    kept = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return kept / 1024


def _of(name: str) -> Any:
    from trade import where

    return where(container=name)


def _wait(holds: Callable[[], bool]) -> None:
    """A thousand that answer may take longer than one waits for them at first; who did not is asked again."""
    until = time.monotonic() + _PATIENCE_S
    while not holds():
        if time.monotonic() > until:
            raise TimeoutError("the last one that joined does not know all")
        time.sleep(0.5)


def _settle(system: Any) -> None:
    """Wait until all containers know everything, which takes some time with a thousand."""
    until = time.monotonic() + _PATIENCE_S
    while time.monotonic() < until:
        try:
            system.settle()
        except TimeoutError:
            continue
        return
    raise TimeoutError("not all containers know everything")


def _median_us(action: Callable[[int], object], times: int) -> float:
    took_us: list[float] = []
    for turn in range(times):
        began = time.perf_counter_ns()
        action(turn)
        took_us.append((time.perf_counter_ns() - began) / 1e3)
    return median(took_us)


def _own_kib(infos: Sequence[Any]) -> float:
    from trade.protocol.messages import encode_message

    return sum(len(encode_message(info)) for info in infos) / 1024
