"""Streams: what five listeners to a joint-state stream cost its source, beside one. All are processes of their own."""

import os
import sys
import time
from contextlib import ExitStack
from multiprocessing.connection import Connection
from statistics import median
from typing import Final

from tests.bench._children import child, hear
from tests.bench._places import own_folder
from tests.bench._report import keep_point, print_target

_SYSTEM, _GROUP = "bench-streams", "bench"
_JOINTS: Final = 12
_HZ: Final = 200.0
_LISTENERS: Final = 5
_MOST: Final = 1.3


def run(rounds: int, seconds: float) -> None:
    """Measure and print.

    Args:
        rounds: how often each number of listeners has its turn.
        seconds: how long each of them listens, in a round.
    """
    cpu: dict[int, list[float]] = {0: [], 1: [], _LISTENERS: []}
    rates: list[float] = []
    with own_folder(), ExitStack() as stack:
        source = stack.enter_context(child(_serve))
        hear(source)
        listeners = [stack.enter_context(child(_listen, f"listener-{i}")) for i in range(_LISTENERS)]
        for listener in listeners:
            hear(listener)
        for i in range(rounds):
            for count, spent in cpu.items():
                share, heard = _round(source, listeners[:count], seconds)
                spent.append(share)
                rates.extend(number / seconds for number in heard)
            print(f"streams: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    print(f"\na stream of {_JOINTS} joint states at {_HZ:g} Hz: processor of its source, medians over {rounds} rounds")
    for count, spent in cpu.items():
        print(f"{count} listeners     {100 * median(spent):6.2f} % ({100 * min(spent):.2f}-{100 * max(spent):.2f})")
        keep_point(
            f"{_JOINTS} joints at {_HZ:g} Hz", f"{count} listeners", rounds, {"% of a core": [100 * x for x in spent]}
        )
    print(f"heard by each    {median(rates):6.1f} samples/s ({min(rates):.1f}-{max(rates):.1f})")
    ratios = [five / one for five, one in zip(cpu[_LISTENERS], cpu[1], strict=True)]
    print_target("five listeners / one", ratios, f"at most {_MOST:g}", lambda ratio: ratio <= _MOST)


def _round(source: Connection, listeners: list[Connection], seconds: float) -> tuple[float, list[int]]:
    """The share of a processor that the source has used, and how many samples each listener has heard."""
    for listener in listeners:
        listener.send("listen")
        hear(listener)
    before, began = _cpu_ns(source), time.perf_counter_ns()
    _reported(listeners, "count")
    time.sleep(seconds)
    heard = _reported(listeners, "counted")
    used, took = _cpu_ns(source) - before, time.perf_counter_ns() - began
    _reported(listeners, "close")
    if not all(heard):
        raise RuntimeError(f"a listener heard no sample: {heard}")
    return used / took, heard


def _reported(listeners: list[Connection], word: str) -> list[int]:
    for listener in listeners:
        listener.send(word)
    return [hear(listener) for listener in listeners]


def _cpu_ns(source: Connection) -> int:
    source.send("cpu")
    return hear(source)


def _serve(pipe: Connection) -> None:
    from trade import Container, Settings, service
    from trade_drivers import MotorState

    class Joints:
        @service(effect="read")
        def state(self) -> list[MotorState]:
            return [
                MotorState(
                    name=f"j{number}",
                    position_rad=0.1 * number,
                    velocity_rad_s=0.0,
                    load=0.0,
                    temperature_c=30.0,
                    voltage_v=12.0,
                    enabled=True,
                    moving=False,
                    measured_at=time.monotonic(),
                    age_s=0.001,
                )
                for number in range(_JOINTS)
            ]

    with Container(Settings.read(container="source", system=_SYSTEM)) as container:
        container.register(Joints(), _GROUP)
        pipe.send("ready")
        try:
            while pipe.recv():
                pipe.send(time.process_time_ns())
        except (EOFError, OSError):  # the parent is done with us
            return


def _listen(pipe: Connection, name: str) -> None:
    from trade import Container, Settings, where

    with Container(Settings.read(container=f"{name}-{os.getpid()}", system=_SYSTEM)) as container:
        handle, heard, stream = container.find(where(name="state", group=_GROUP), wait_s=20), 0, None

        def count(_value: object) -> None:
            nonlocal heard
            heard += 1

        pipe.send("ready")
        while True:
            try:
                word = pipe.recv()
            except (EOFError, OSError):
                return
            if word == "listen":
                stream = container.stream(handle, hz=_HZ, call=count)
            elif word == "count":
                heard = 0
            elif word == "close" and stream is not None:
                stream.close()
            pipe.send(heard)
