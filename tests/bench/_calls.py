"""Remote calls against their peers, interleaved in one run, so that what disturbs one disturbs all.

One call at a time for the latency, then 32 under way for the rate.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from statistics import median
from typing import Final

from tests.bench._children import Job, Round, Running, running
from tests.bench._links import Peer
from tests.bench._others import Grpc, Pyro5, Rpyc
from tests.bench._ours import LocalTrade, Trade, TradeThreads
from tests.bench._peers import BarePair, Tcp
from tests.bench._places import own_folder
from tests.bench._report import print_target

_PEERS: Final[Sequence[Peer]] = (Tcp(), BarePair(), Trade(), Rpyc(), Pyro5(), Grpc(), LocalTrade())
_IN_FLIGHT_PEERS: Final[Sequence[Peer]] = (Tcp(), BarePair(), Trade(), TradeThreads(), Rpyc(), Pyro5(), Grpc())
_IN_FLIGHT: Final = 32
_SIZES: Final = {64: 1.0, 4096: 1.0, 65_536: 0.5, 2 * 1024 * 1024: 0.05}
"""Bytes, and the share of the calls asked for that so large ones are worth."""
_NAMES: Final = {64: "64 B", 4096: "4 KiB", 65_536: "64 KiB", 2 * 1024 * 1024: "2 MiB"}

_MOST_P50: Final = 1.3
_MOST_CPU: Final = 1.5
_LEAST_RATE: Final = 0.6

P50 = ("p50_us", "p50_us")
_P99 = ("p99_us", "p50_us")
CPU = ("cpu_us", "cpu_us")
_RATE = ("calls_per_s", "calls_per_s")
"""What of one peer is divided by what of another."""

Results = Mapping[str, Sequence[Round]]


def run(n: int, rounds: int) -> None:
    """Measure and print the latency of single calls.

    Args:
        n: calls of each peer in a round, fewer of large ones.
        rounds: how often every peer has its turn.
    """
    with up(_PEERS) as peers:
        for size, share in _SIZES.items():
            results = measure(f"calls of {_NAMES[size]}", peers, Job(size, max(1, int(n * share))), rounds)
            _print_latency(results, size, max(1, int(n * share)))
            _print_latency_targets(results, size)


def run_in_flight(n: int, rounds: int) -> None:
    """Measure and print the rate of calls of which 32 are under way; as above, but of large ones, too, at least 32."""
    with up(_IN_FLIGHT_PEERS) as peers:
        for size, share in _SIZES.items():
            job = Job(size, max(min(n, _IN_FLIGHT), int(n * share)), _IN_FLIGHT)
            _print_rate(measure(f"{_IN_FLIGHT} in flight of {_NAMES[size]}", peers, job, rounds), job)


@contextmanager
def up(wanted: Sequence[Peer]) -> Iterator[list[Running]]:
    """Processes of those that are installed, in a folder of their own; the others are named."""
    for peer in wanted:
        if peer.missing:
            print(f"{peer.name}: skipped, the module {peer.needs} is not installed")
    with own_folder(), ExitStack() as stack:
        yield [stack.enter_context(running(peer)) for peer in wanted if not peer.missing]


def measure(what: str, peers: Sequence[Running], job: Job, rounds: int) -> Results:
    """So many rounds of each, interleaved; who comes first changes."""
    for peer in peers:
        peer.run(job)  # a first round for caches and connections; not counted
    results: dict[str, list[Round]] = {peer.name: [] for peer in peers}
    for i in range(rounds):
        first = i % len(peers)  # who comes after whom changes
        for peer in (*peers[first:], *peers[:first]):
            results[peer.name].append(peer.run(job))
        print(f"{what}: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    return results


def _print_latency(results: Results, size: int, n: int) -> None:
    bare = results[BarePair.name]
    title = f"remote call of {_NAMES[size]}: medians over {len(bare)} rounds of {n} calls"
    print(f"\n{title}; x: times the bare pair's p50 or CPU")
    print(f"{'':16}{'p50':>10}{'p99':>11}{'CPU':>11}{'p50':>8}{'p99':>8}{'CPU':>8}")
    for name, rounds in results.items():
        us = [median(getattr(one, what) for one in rounds) for what in ("p50_us", "p99_us", "cpu_us")]
        x = [median(ratios(rounds, bare, *what)) for what in (P50, _P99, CPU)]
        print(f"{name:15}" + "".join(f"{value:8.1f} us" for value in us) + "".join(f"{value:7.2f}x" for value in x))


def _print_rate(results: Results, job: Job) -> None:
    bare = results[BarePair.name]
    title = f"{job.in_flight} calls of {_NAMES[job.size]} in flight: medians over {len(bare)} rounds of {job.n} calls"
    print(f"\n{title}; x: times the bare pair's rate or CPU")
    print(f"{'':16}{'calls/s':>10}{'CPU a call':>13}{'rate':>8}{'CPU':>8}")
    for name, rounds in results.items():
        rate, cpu_us = (median(getattr(one, what) for one in rounds) for what in ("calls_per_s", "cpu_us"))
        x = "".join(f"{median(ratios(rounds, bare, *what)):7.2f}x" for what in (_RATE, CPU))
        print(f"{name:16}{rate:10.0f}{cpu_us:10.1f} us{x}")
    for name in (Trade.name, TradeThreads.name):
        what = f"{name}: rate / bare pair"
        share = ratios(results[name], bare, *_RATE)
        print_target(what, share, f"at least {_LEAST_RATE}", lambda x: x >= _LEAST_RATE)


def ratios(rounds: Sequence[Round], others: Sequence[Round], what: str, of: str) -> list[float]:
    """Round by round: two that stand next to each other saw the same machine."""
    return [getattr(one, what) / getattr(other, of) for one, other in zip(rounds, others, strict=True)]


def _print_latency_targets(results: Results, size: int) -> None:
    ours, bare = results[Trade.name], results[BarePair.name]
    of = _NAMES[size]
    print_target(f"{of}: p50 / bare pair", ratios(ours, bare, *P50), f"at most {_MOST_P50}", lambda x: x <= _MOST_P50)
    print_target(f"{of}: CPU / bare pair", ratios(ours, bare, *CPU), f"at most {_MOST_CPU}", lambda x: x <= _MOST_CPU)
    if rpyc := results.get(Rpyc.name):
        print_target(f"{of}: p50 / rpyc", ratios(ours, rpyc, *P50), "below 1", lambda x: x < 1)
