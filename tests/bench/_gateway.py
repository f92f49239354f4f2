"""Gateways: calls through one and two in a row, beside the direct call and a bare zenoh pair over the same regions.

Before that, a gateway with nothing to do, and one through which a client floods.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from statistics import median
from typing import Final

from tests.bench import _flood, _idle
from tests.bench._across import BareAcross, TradeAcross
from tests.bench._calls import CPU, P50, Results, measure, print_latency, print_rate, ratios, up, worth
from tests.bench._children import Job, Running, child, hear
from tests.bench._places import own_folder
from tests.bench._report import print_target
from tests.bench._site import PLAIN, SECURE, Site, site

_SIZE: Final = 64
_LARGE_SIZE, _LARGE_SHARE = 2 * 1024 * 1024, 0.05
_IN_FLIGHT: Final = 32
_MOST_OF_DIRECT, _MOST_OF_MESSAGES, _MOST_OF_DIRECT_TWO, _LEAST_RATE = 2.0, 1.5, 3.0, 5000

_DIRECT, _ONE, _TWO = "TRADE, direct", "TRADE, one gateway", "TRADE, two gateways"
_BARE, _BARE_TLS, _BARE_RULES = "bare pair, plain", "bare pair, TLS", "bare pair, rules"
_MESSAGES, _MESSAGES_TLS = "bare messages, plain", "bare messages, TLS"
_DIRECT_PLAIN, _ONE_PLAIN = "TRADE, direct, plain", "TRADE, one, plain"


def run(n: int, rounds: int, idle_s: float) -> None:
    """Measure and print.

    Args:
        n: calls of each pair in a round, and of the honest caller beside a flood.
        rounds: turns of each pair; a quarter as many of each flood.
        idle_s: how long the idle gateway is looked at.
    """
    with own_folder(), site() as where:
        if where is not None:
            door = where.begin_gateway("door", SECURE)
            _idle.run(where, door, idle_s)
            _flood.run(where, n, max(1, rounds // 4))
            _run_pairs(where, n, rounds)


def _run_pairs(site: Site, n: int, rounds: int) -> None:
    with _up(site) as pairs:
        job = Job(_SIZE, n)
        results = measure("calls through gateways", pairs, job, rounds)
        print_latency("remote call of 64 B between hosts", results, job, _BARE_TLS)
        _print_costs(results)
        secure = [pair for pair in pairs if pair.name in (_BARE_TLS, _DIRECT, _ONE, _TWO)]
        job = Job(_LARGE_SIZE, worth(n, rounds, _LARGE_SHARE))
        large = measure("calls of 2 MiB through gateways", secure, job, rounds)
        print_latency("remote call of 2 MiB between hosts", large, job, _BARE_TLS)
        through = [pair for pair in pairs if pair in secure or pair.name == _ONE_PLAIN]
        job = Job(_SIZE, max(n, _IN_FLIGHT), _IN_FLIGHT)
        many = measure(f"{_IN_FLIGHT} in flight through a gateway", through, job, rounds)
        print_rate(f"{_IN_FLIGHT} calls of 64 B in flight between hosts", many, job, _BARE_TLS)
        _print_rate_target(many)


@contextmanager
def _up(site: Site) -> Iterator[Sequence[Running]]:
    bare = (
        BareAcross(site, _BARE, 7471),
        BareAcross(site, _BARE_TLS, 7472, tls=True),
        BareAcross(site, _BARE_RULES, 7473, tls=True, rules=True),
        BareAcross(site, _MESSAGES, 7474, typed=True),
        BareAcross(site, _MESSAGES_TLS, 7475, tls=True, typed=True),
    )
    ours = (
        TradeAcross(site, _DIRECT_PLAIN, "aside", PLAIN),
        TradeAcross(site, _ONE_PLAIN, "office", PLAIN, "door"),
        TradeAcross(site, _DIRECT, "aside", SECURE),
        TradeAcross(site, _ONE, "office", SECURE, "door"),
        TradeAcross(site, _TWO, "home", SECURE, "gate"),
    )
    with ExitStack() as stack:
        for pair in bare:
            hear(stack.enter_context(child(_route, pair, inside=pair.router_at)))
        for gateway, port in (("gate", SECURE), ("door", PLAIN)):
            site.begin_gateway(gateway, port)
        yield stack.enter_context(up([*bare, *ours]))


def _route(pipe, pair: BareAcross) -> None:
    pair.route(pipe)


def _print_costs(results: Results) -> None:
    print("both kinds of direct call are between two hosts of one network")
    for what, one, other in (
        ("TLS costs a bare pair", _BARE_TLS, _BARE),
        ("rules cost a bare pair", _BARE_RULES, _BARE_TLS),
        ("both cost a direct call", _DIRECT, _DIRECT_PLAIN),
        ("both cost through a gateway", _ONE, _ONE_PLAIN),
    ):
        x = [median(ratios(results[one], results[other], *ratio)) for ratio in (P50, CPU)]
        print(f"{what:32} {x[0]:5.2f} x the p50, {x[1]:.2f} x the CPU of the ends")
    for what, one, other, most in (
        ("one gateway: p50 / direct", _ONE, _DIRECT, _MOST_OF_DIRECT),
        ("one gateway: p50 / bare messages", _ONE, _MESSAGES_TLS, _MOST_OF_MESSAGES),
        ("one, plain: p50 / bare messages, plain", _ONE_PLAIN, _MESSAGES, _MOST_OF_MESSAGES),
        ("two gateways: p50 / direct", _TWO, _DIRECT, _MOST_OF_DIRECT_TWO),
    ):
        x = ratios(results[one], results[other], *P50)
        print_target(what, x, f"at most {most:.1f}", lambda x, most=most: x <= most)


def _print_rate_target(results: Results) -> None:
    what = f"one gateway, {_IN_FLIGHT} in flight: /s"
    rates = [one.calls_per_s for one in results[_ONE]]
    print_target(what, rates, f"at least {_LEAST_RATE}", lambda x: x >= _LEAST_RATE)
