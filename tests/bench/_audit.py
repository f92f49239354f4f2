"""What an audit record costs a call, and how many records a second it takes."""

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median, quantiles
from typing import Final

from tests.bench._alone import alone
from tests.bench._children import child, hear
from tests.bench._places import on_one_processor, own_folder
from tests.bench._report import keep_point, print_target

_SYSTEM: Final = "bench-audit"
_OFF, _ON = "off", "on"
_RATE: Final = 2000
_TARGETS: Final = {"p50: audit on / off": 1.05, "p99: with records / without": 1.5}
_IN_TURN: Final = 50
"""Calls before it is the other one's turn: what disturbs one disturbs both."""
_BATCH_S: Final = 0.3
"""Longer than the writer collects records for."""


def run(n: int, rounds: int, seconds: float) -> None:
    """Measure and print.

    Args:
        n: calls in a round.
        rounds: how often each kind has its turn.
        seconds: how long records come in.
    """
    with own_folder(), tempfile.TemporaryDirectory() as folder:
        with on_one_processor():  # what a record costs is less than what another place of the two ends does
            results = _measure_calls(folder, n, rounds)
        written, lost, cpu = alone(_measure_rate, folder, seconds)
    print(f"\na call to another process on one processor, medians over {rounds} rounds of {n}")
    for name, pairs in results.items():
        p50, p99 = (median(values) for values in zip(*pairs, strict=True))
        print(f"audit {name:10}{p50:8.1f} us, p99 {p99:8.1f} us")
        keep_point("a call to another process", f"audit {name}", n * rounds, _by_name(pairs))
    for i, (what, most) in enumerate(_TARGETS.items()):
        shares = [on[i] / off[i] for on, off in zip(results[_ON], results[_OFF], strict=True)]
        print_target(what, shares, f"at most {most:g}", lambda x, most=most: x <= most)
    print(f"{_RATE} records/s for {seconds:g} s: {lost} lost, {cpu:.0f} % of a core")
    keep_point(f"{_RATE} records/s", "written", int(_RATE * seconds), {"records/s": [written], "% of a core": [cpu]})
    print_target("records/s written", [written], f"at least {0.99 * _RATE:g}", lambda rate: rate >= 0.99 * _RATE)


def _by_name(pairs: Sequence[tuple[float, float]]) -> dict[str, Sequence[float]]:
    return {"p50, us": [p50 for p50, _ in pairs], "p99, us": [p99 for _, p99 in pairs]}


def _serve(pipe, name: str, folder: str) -> None:
    from trade import Container, Settings, service

    class Lamp:
        @service
        def dim(self, level: float) -> float:
            return level

    with Container(Settings.read(container=name, system=_SYSTEM, audit=Path(folder) if folder else None)) as container:
        container.register(Lamp(), name)
        pipe.send("up")
        pipe.poll(None)


def _measure_calls(folder: str, n: int, rounds: int) -> dict[str, list[tuple[float, float]]]:
    from trade import Container, Settings, where

    results: dict[str, list[tuple[float, float]]] = {_OFF: [], _ON: []}
    with (
        child(_serve, _OFF, "") as plain,
        child(_serve, _ON, folder) as kept,
        Container(Settings.read(container="caller", system=_SYSTEM)) as container,
    ):
        hear(plain)
        hear(kept)
        lamps = {name: container.find(where(name="dim", group=name), wait_s=30) for name in results}
        for i in range(rounds):
            took_us: dict[str, list[float]] = {_OFF: [], _ON: []}
            for done in range(0, n, _IN_TURN):
                for name, took in took_us.items():
                    for _ in range(min(_IN_TURN, n - done)):
                        began = time.perf_counter_ns()
                        lamps[name](0.5)
                        took.append((time.perf_counter_ns() - began) / 1e3)
            for name, took in took_us.items():
                results[name].append((median(took), quantiles(took, n=100)[98]))
            print(f"audit: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    return results


def _measure_rate(folder: str, seconds: float) -> tuple[float, int, float]:
    """Records a second that were written, those lost, and per cent of a core."""
    from trade._audit.events import Event
    from trade._audit.store import Retention
    from trade._audit.writer import AuditWriter

    writer = AuditWriter(Path(folder) / "rate.sqlite", "bench", "", Retention(90, 10_000_000))
    event = Event(time.time_ns(), 1, "call", "rosie.arm.reach", "", "anna", "anna/mind/1", 7, 3, "ok", "", 5)
    cpu_s, began, reported = time.process_time(), time.monotonic(), 0
    while (gone_s := time.monotonic() - began) < seconds:
        for _ in range(reported, int(gone_s * _RATE)):
            writer.tell(event)
            reported += 1
        time.sleep(0.005)
    while writer.waiting and time.monotonic() - began < 10 * seconds:
        time.sleep(0.001)
    took_s = time.monotonic() - began
    if took_s - gone_s <= _BATCH_S:  # it kept up: the last ones were collected for a while, as all are
        took_s = gone_s
    writer.close()
    return (writer.written - 2) / took_s, writer.lost, (time.process_time() - cpu_s) / took_s * 100
