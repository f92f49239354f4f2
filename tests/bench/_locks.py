"""Locks: what taking and giving back costs beside a call, and what the checks of resources add to a call.

Calls within a host take a fifth of the time of a call on the transport, but four calls to two processes cannot. So the
target is beside a call on the transport, as between hosts; the other ratio is printed without one.
"""

import os
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from statistics import median
from typing import Final

from tests.bench._alone import alone
from tests.bench._children import child, hear
from tests.bench._places import own_folder
from tests.bench._report import keep_point, print_target

_SYSTEM, _GROUP = "bench-locks", "bench"
_HOSTS: Final = ("one", "other")
_MOST_CALLS: Final = 3.0
_MOST_CHECKS: Final = 1.05
_LOCK, _CALL, _UNCHECKED = "lock and unlock", "call", "call, unchecked"
_ON_TRANSPORT: Final = "call on the transport"

Results = dict[str, list[float]]


def run(n: int, rounds: int) -> None:
    """Measure and print.

    Args:
        n: calls, or locks, of each kind in a round.
        rounds: how often each kind has its turn.
    """
    with own_folder(), child(_serve, _HOSTS[0]) as one, child(_serve, _HOSTS[1]) as other:
        for server in (one, other):
            hear(server)
        results = alone(_measure, n, rounds)
    print(f"\nfour services on two containers in processes of their own: medians over {rounds} rounds of {n}")
    for name, us in results.items():
        print(f"{name:22}{median(us):8.1f} us")
        keep_point("four services of two containers", name, n * rounds, {"p50, us": us})
    print(f"lock and unlock / call: {median(results[_LOCK]) / median(results[_CALL]):.1f}")
    costs = [lock / call for lock, call in zip(results[_LOCK], results[_ON_TRANSPORT], strict=True)]
    name = f"lock and unlock / {_ON_TRANSPORT}"
    print_target(name, costs, f"at most {_MOST_CALLS:g}", lambda share: share <= _MOST_CALLS)
    checks = [call / unchecked for call, unchecked in zip(results[_CALL], results[_UNCHECKED], strict=True)]
    print_target("checked / unchecked call", checks, f"at most {_MOST_CHECKS:g}", lambda share: share <= _MOST_CHECKS)


def _serve(pipe: Connection, host: str) -> None:
    from trade import Container, Settings, service

    class Joint:
        def __init__(self, name: str) -> None:
            self.resources = (name,)

        @service
        def move(self, angle_rad: float) -> float:
            return angle_rad

        @service
        def move_unchecked(self, angle_rad: float) -> float:
            return angle_rad

        @service(effect="stop")
        def stop(self) -> None:
            """Nothing moves here."""

    with Container(Settings.read(container=host, system=_SYSTEM)) as container:
        for name in ("pan", "tilt"):
            for handle in container.register(Joint(f"{host}.{name}"), f"{_GROUP}.{host}.{name}"):
                local = container._parts.providers.lookup(f"{handle.key.domain}/{handle.key.provider}", handle.name)
                if handle.name == "move_unchecked" and local is not None:
                    local.resources = ()
        pipe.send("ready")
        try:
            pipe.recv()
        except (EOFError, OSError):  # the parent is done with us
            return


def _measure(n: int, rounds: int) -> Results:
    from trade import Container, Settings, where

    far = Settings.read(container="far", system=_SYSTEM, environment={**os.environ, "TRADE_LOCAL_PATH": "0"})
    with Container(Settings.read(container="client", system=_SYSTEM)) as container, Container(far) as beside:
        on_transport = beside.find(where(name="move", group=f"{_GROUP}.one.pan"), wait_s=10)
        checked, unchecked = (
            container.find(where(name=name, group=f"{_GROUP}.one.pan"), wait_s=10)
            for name in ("move", "move_unchecked")
        )
        container.find(where(name="move", group=f"{_GROUP}.other.tilt"), wait_s=10)
        four = container.services(where(name="move", group=_GROUP))

        def lock() -> None:
            with container.lock(four):
                pass

        kinds: dict[str, Callable[[], object]] = {
            _LOCK: lock,
            _CALL: lambda: checked(0.1),
            _ON_TRANSPORT: lambda: on_transport(0.1),
            _UNCHECKED: lambda: unchecked(0.1),
        }
        results: Results = {name: [] for name in kinds}
        for i in range(rounds):
            for name, do in kinds.items():
                results[name].append(_p50_us(do, n))
            print(f"locks: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
        return results


def _p50_us(do: Callable[[], object], n: int) -> float:
    do()
    took_us: list[float] = []
    for _ in range(n):
        began = time.perf_counter_ns()
        do()
        took_us.append((time.perf_counter_ns() - began) / 1e3)
    return median(took_us)
