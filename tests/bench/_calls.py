"""Remote calls against their peers, interleaved in one run, so that what disturbs one disturbs all.

One call at a time for the latency, then 32 under way for the rate.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from math import ceil
from statistics import median
from typing import Final

from tests.bench._children import Job, Round, Running, running
from tests.bench._links import Peer
from tests.bench._messages import BareCopies, BareMessages, BareMessagesThreads
from tests.bench._others import Grpc, Pyro5, Rpyc
from tests.bench._peers import BarePair, BareQuery, Tcp
from tests.bench._places import on_one_processor, own_folder
from tests.bench._report import keep_point, print_skipped, print_target
from tests.bench._ros1 import Rospy
from tests.bench._trade import LocalTrade, Trade, TradeThreads
from tests.bench._viam import Viam

_OTHERS: Final[Sequence[Peer]] = (Rpyc(), Pyro5(), Grpc(), Rospy(), Viam())
_FLOORS: Final[Sequence[Peer]] = (Tcp(), BareMessages(), BareCopies(), BarePair(), BareQuery())
_PEERS: Final[Sequence[Peer]] = (*_FLOORS, Trade(), *_OTHERS, LocalTrade())
_IN_FLIGHT_PEERS: Final[Sequence[Peer]] = (
    Tcp(),
    BareMessages(),
    BareMessagesThreads(),
    BarePair(),
    BareQuery(),
    Trade(),
    TradeThreads(),
    *_OTHERS,
)
_IN_FLIGHT: Final = 32
_SMALL, _MIDDLE, _LARGE = 64, 65_536, 2 * 1024 * 1024
_SIZES: Final = {_SMALL: 1.0, 4096: 1.0, _MIDDLE: 0.5, _LARGE: 0.05}
"""Bytes, and the share of the calls asked for that so large ones are worth, as long as there are `_ENOUGH`."""
NAMES: Final = {_SMALL: "64 B", 4096: "4 KiB", _MIDDLE: "64 KiB", _LARGE: "2 MiB"}
_ENOUGH: Final = 2000
"""Calls of a point in all rounds together, unless fewer are asked for."""

_MOST_P50, _MOST_SPREAD, _MOST_CPU = 1.3, 1.5, 0.6
_MOST_OF_OTHERS: Final = {Rpyc.name: 0.85, Grpc.name: 0.22, Viam.name: 0.12}
_MOST_ON_ONE: Final = {BareMessages.name: 2.5, Pyro5.name: 0.75}
"""With both ends on one processor: waking an idle processor takes a virtual machine as long as some of them take."""
_MOST_OF_COPIES, _LEAST_SHARE, _LEAST_OF_MESSAGES, _LEAST_RATE = 1.5, 0.6, 0.5, 18_000

P50 = ("p50_us", "p50_us")
_P99 = ("p99_us", "p50_us")
CPU = ("cpu_us", "cpu_us")
RATE = ("calls_per_s", "calls_per_s")
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
            job = Job(size, worth(n, rounds, share))
            results = measure(f"calls of {NAMES[size]}", peers, job, rounds)
            print_latency(f"remote call of {NAMES[size]}", results, job)
            _print_latency_targets(results, size)
    with on_one_processor(), up(_PEERS) as peers:
        title = f"remote call of {NAMES[_SMALL]}, both ends on one processor"
        job = Job(_SMALL, worth(n, rounds, _SIZES[_SMALL]))
        results = measure(f"calls of {NAMES[_SMALL]} on one processor", peers, job, rounds)
        print_latency(title, results, job)
        _print_targets_of(results, f"{NAMES[_SMALL]}, one processor", _MOST_ON_ONE)


def run_in_flight(n: int, rounds: int) -> None:
    """Measure and print the rate of calls of which 32 are under way; as above, but of large ones, too, at least 32."""
    with up(_IN_FLIGHT_PEERS) as peers:
        for size, share in _SIZES.items():
            job = Job(size, max(min(n, _IN_FLIGHT), worth(n, rounds, share)), _IN_FLIGHT)
            results = measure(f"{_IN_FLIGHT} in flight of {NAMES[size]}", peers, job, rounds)
            print_rate(f"{_IN_FLIGHT} calls of {NAMES[size]} in flight", results, job)
            _print_rate_targets(results, size)


def worth(n: int, rounds: int, share: float) -> int:
    """Calls of a round, of those asked for."""
    return max(1, int(n * share), min(n, ceil(_ENOUGH / rounds)))


@contextmanager
def up(wanted: Sequence[Peer]) -> Iterator[list[Running]]:
    """Processes of those that are installed, in a folder of their own; the others are named."""
    for peer in wanted:
        if peer.missing:
            print_skipped(peer.name, peer.missing)
    with own_folder(), ExitStack() as stack:
        yield [stack.enter_context(running(peer)) for peer in wanted if not peer.missing]


def measure(what: str, peers: Sequence[Running], job: Job, rounds: int) -> Results:
    """So many rounds of each, interleaved; who comes first changes. Whom such calls would take minutes is left out."""
    for peer in peers:
        if job.size > peer.most_bytes:
            print_skipped(f"{peer.name}, {what}", "they would take minutes")
    peers = [peer for peer in peers if peer.least_bytes <= job.size <= peer.most_bytes]
    for peer in peers:
        peer.run(job)  # a first round for caches and connections; not counted
    results: dict[str, list[Round]] = {peer.name: [] for peer in peers}
    for i in range(rounds):
        first = i % len(peers)  # who comes after whom changes
        for peer in (*peers[first:], *peers[:first]):
            results[peer.name].append(peer.run(job))
        print(f"{what}: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    return results


def print_latency(title: str, results: Results, job: Job, bare_name: str = BarePair.name) -> None:
    """Print and keep the p50, p99 and CPU of each, and their ratios to the bare pair of the same round."""
    bare = results[bare_name]
    print(f"\n{title}: medians over {len(bare)} rounds of {job.n} calls; x: times the {bare_name}'s p50 or CPU")
    print(f"{'':22}{'p50':>10}{'p99':>11}{'CPU':>11}{'p50':>8}{'p99':>8}{'CPU':>8}")
    for name, rounds in results.items():
        values = latency(rounds) | {
            f"{what} / bare": ratios(rounds, bare, *of) for what, of in (("p50", P50), ("p99", _P99), ("CPU", CPU))
        }
        us, x = list(values.values())[:3], list(values.values())[3:]
        shown = "".join(f"{median(each):8.1f} us" for each in us) + "".join(f"{median(each):7.2f}x" for each in x)
        print(f"{name:21}{shown}")
        keep_point(title, name, job.n * len(rounds), values)


def latency(rounds: Sequence[Round]) -> dict[str, list[float]]:
    """What a point of single calls has."""
    return {
        "p50, us": [one.p50_us for one in rounds],
        "p99, us": [one.p99_us for one in rounds],
        "CPU, us": [one.cpu_us for one in rounds],
    }


def print_rate(title: str, results: Results, job: Job, bare_name: str = BarePair.name) -> None:
    """Print and keep the calls a second and CPU of each, and their ratios to the bare pair of the same round."""
    bare = results[bare_name]
    print(f"\n{title}: medians over {len(bare)} rounds of {job.n} calls; x: times the {bare_name}'s rate or CPU")
    print(f"{'':22}{'calls/s':>10}{'CPU a call':>13}{'rate':>8}{'CPU':>8}")
    for name, rounds in results.items():
        values = {
            "calls/s": [one.calls_per_s for one in rounds],
            "CPU, us": [one.cpu_us for one in rounds],
            "rate / bare": ratios(rounds, bare, *RATE),
            "CPU / bare": ratios(rounds, bare, *CPU),
        }
        rate, cpu_us, *x = (median(each) for each in values.values())
        print(f"{name:22}{rate:10.0f}{cpu_us:10.1f} us" + "".join(f"{each:7.2f}x" for each in x))
        keep_point(title, name, job.n * len(rounds), values)


def ratios(rounds: Sequence[Round], others: Sequence[Round], what: str, of: str) -> list[float]:
    """Round by round: two that stand next to each other saw the same machine."""
    return [getattr(one, what) / getattr(other, of) for one, other in zip(rounds, others, strict=True)]


def _print_latency_targets(results: Results, size: int) -> None:
    ours, bare, of = results[Trade.name], results[BarePair.name], NAMES[size]
    if size == _LARGE:
        x = ratios(ours, results[BareCopies.name], *P50)
        print_target(f"{of}: p50 / bare copies", x, f"at most {_MOST_OF_COPIES}", lambda x: x <= _MOST_OF_COPIES)
    else:
        print_target(
            f"{of}: p50 / bare pair", ratios(ours, bare, *P50), f"at most {_MOST_P50}", lambda x: x <= _MOST_P50
        )
        print_target(
            f"{of}: CPU / bare pair", ratios(ours, bare, *CPU), f"at most {_MOST_CPU}", lambda x: x <= _MOST_CPU
        )
    _print_targets_of(
        results, of, {name: most for name, most in _MOST_OF_OTHERS.items() if size == _SMALL or name == Rpyc.name}
    )
    if size == _SMALL:
        spreads = (ratios(one, one, *_P99) for one in (ours, results[Tcp.name]))
        x = [own / other for own, other in zip(*spreads, strict=True)]
        print_target(f"{of}: p99 / p50, over raw TCP's", x, f"at most {_MOST_SPREAD}", lambda x: x <= _MOST_SPREAD)


def _print_targets_of(results: Results, of: str, most_of: Mapping[str, float]) -> None:
    for name, most in most_of.items():
        if name in results:
            x = ratios(results[Trade.name], results[name], *P50)
            print_target(f"{of}: p50 / {name}", x, f"at most {most:g}", lambda x, most=most: x <= most)


def _print_rate_targets(results: Results, size: int) -> None:
    floor = BareMessagesThreads.name
    for name, other, least in (
        (Trade.name, *((floor, _LEAST_OF_MESSAGES) if size == _MIDDLE else (BarePair.name, _LEAST_SHARE))),
        (TradeThreads.name, floor, _LEAST_OF_MESSAGES),
    ):
        share = ratios(results[name], results[other], *RATE)
        what = f"{NAMES[size]}, {name}: rate / {other.replace('zenoh ', '')}"
        print_target(what, share, f"at least {least}", lambda x, least=least: x >= least)
    if size == _SMALL:
        rate = [one.calls_per_s for one in results[Trade.name]]
        print_target(
            f"{NAMES[size]}, {_IN_FLIGHT} in flight: /s", rate, f"at least {_LEAST_RATE}", lambda x: x >= _LEAST_RATE
        )
