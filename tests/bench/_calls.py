"""A remote call of 64 bytes against its peers, interleaved in one run, so that what disturbs one disturbs all."""

import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from statistics import median

from tests.bench._children import Round, Running, running
from tests.bench._peers import BarePair, LocalTrade, Peer, Rpyc, Tcp, Trade
from tests.bench._report import print_target

_PEERS: Sequence[Peer] = (Tcp(), BarePair(), Trade(), Rpyc(), LocalTrade())
_MOST_P50 = 1.3
_MOST_CPU = 1.5

_P50 = ("p50_us", "p50_us")
_P99 = ("p99_us", "p50_us")
_CPU = ("cpu_us", "cpu_us")
"""What of one peer is divided by what of another."""

Results = Mapping[str, Sequence[Round]]


def run(n: int, rounds: int) -> None:
    """Measure and print.

    Args:
        n: calls of each peer in a round.
        rounds: how often every peer has its turn.
    """
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        os.environ["TRADE_RUNTIME_DIR"] = folder  # of this run alone, as the children inherit it
        peers = [stack.enter_context(running(peer)) for peer in _PEERS]
        results = _measure(peers, n, rounds)
    _print_table(results, n)
    _print_targets(results)


def _measure(peers: Sequence[Running], n: int, rounds: int) -> Results:
    for peer in peers:
        peer.run(n)  # a first round for caches and connections; not counted
    results: dict[str, list[Round]] = {peer.name: [] for peer in peers}
    for i in range(rounds):
        first = i % len(peers)  # who comes after whom changes
        for peer in (*peers[first:], *peers[:first]):
            results[peer.name].append(peer.run(n))
        print(f"calls: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    return results


def _print_table(results: Results, n: int) -> None:
    bare = results[BarePair.name]
    print(f"remote call of 64 bytes: medians over {len(bare)} rounds of {n} calls; x: times the bare pair's p50 or CPU")
    print(f"{'':16}{'p50':>9}{'p99':>9}{'CPU':>9}{'p50':>8}{'p99':>8}{'CPU':>8}")
    for name, rounds in results.items():
        us = [median(getattr(one, what) for one in rounds) for what in ("p50_us", "p99_us", "cpu_us")]
        x = [median(_ratios(rounds, bare, *what)) for what in (_P50, _P99, _CPU)]
        print(f"{name:16}" + "".join(f"{value:6.1f} us" for value in us) + "".join(f"{value:7.2f}x" for value in x))


def _ratios(rounds: Sequence[Round], others: Sequence[Round], what: str, of: str) -> list[float]:
    """Round by round: two that stand next to each other saw the same machine."""
    return [getattr(one, what) / getattr(other, of) for one, other in zip(rounds, others, strict=True)]


def _print_targets(results: Results) -> None:
    ours, bare, rpyc = results[Trade.name], results[BarePair.name], results[Rpyc.name]
    print_target("p50 / bare pair", _ratios(ours, bare, *_P50), f"at most {_MOST_P50}", lambda x: x <= _MOST_P50)
    print_target("CPU / bare pair", _ratios(ours, bare, *_CPU), f"at most {_MOST_CPU}", lambda x: x <= _MOST_CPU)
    print_target("p50 / rpyc", _ratios(ours, rpyc, *_P50), "below 1", lambda x: x < 1)
