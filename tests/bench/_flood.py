"""What one identity's flood through a gateway leaves to another one: its calls and its stops."""

import math
import statistics
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from tests.bench._across import bare_session
from tests.bench._children import child, hear
from tests.bench._report import keep_point, print_target
from tests.bench._site import ADDRESSES, SECURE, SYSTEM, Site

RATE_HZ: Final = 50_000
_TICK_S: Final = 0.001
_MOST_TIMES_P99, _MOST_CALL_MS, _MOST_STOP_MS = 20.0, 250.0, 50.0
_PATIENCE_S: Final = 2.0
_DRAINED_S: Final = 30.0
_ROUND_S: Final = 5.0
"""A round ends after so long, however few calls were answered."""
_GROUP: Final = "bench.flooded"
_PORT: Final = 7480


@dataclass(frozen=True, slots=True)
class Flood:
    """What mallory puts, as often as it can up to the rate."""

    name: str
    kind: str = "call"
    waits: bool = True
    """Puts block where a link is full, and go out at once, as our own calls do; else they are batched, and dropped."""
    junk: bool = False
    """Bytes that are no call."""


_QUIET: Final = "no flood"
FLOODS: Final = (
    Flood("calls, one by one"),
    Flood("calls, batched", waits=False),
    Flood("no calls, batched", waits=False, junk=True),
    Flood("stops, one by one", kind="stop"),
)


@dataclass(frozen=True, slots=True)
class Felt:
    """A round of the honest caller: milliseconds, infinite for what was not answered."""

    call_ms: Sequence[float]
    stop_ms: Sequence[float]
    sent_hz: float = 0.0
    ran_hz: float = 0.0
    """What the flood sent, and which calls of all clients ran at the robot."""


def run(site: Site, n: int, rounds: int) -> None:
    """Measure and print.

    Args:
        site: where the gateway runs, with certificates.
        n: calls and stops of the honest caller in a round.
        rounds: turns of each flood.
    """
    results: dict[str, list[Felt]] = {name: [] for name in (_QUIET, *(flood.name for flood in FLOODS))}
    with _up(site) as (robot, planner, mallory):
        _ask(planner, n)  # not counted
        for i in range(rounds):
            results[_QUIET].append(Felt(*_ask(planner, n)))
            for flood in FLOODS:
                results[flood.name].append(_flooded(robot, planner, mallory, flood, n))
            print(f"floods: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    _print(results, n)


def _flooded(robot: Connection, planner: Connection, mallory: Connection, flood: Flood, n: int) -> Felt:
    before, began = _ask(robot, "ran"), time.monotonic()
    _ask(mallory, flood)
    felt = _ask(planner, n)
    sent_hz = _ask(mallory, None)
    ran_hz = (_ask(robot, "ran") - before) / (time.monotonic() - began)
    _wait_until_drained(robot)
    return Felt(*felt, sent_hz, ran_hz)


def _wait_until_drained(robot: Connection) -> None:
    """What is left of one flood would be counted with the next. Raises RuntimeError if there is no end of it."""
    ran, until = -1, time.monotonic() + _DRAINED_S
    while (now := _ask(robot, "ran")) != ran:
        if time.monotonic() > until:
            raise RuntimeError(f"the robot still runs what was sent {_DRAINED_S} s ago")
        ran = now
        time.sleep(0.2)


@contextmanager
def _up(site: Site) -> Iterator[tuple[Connection, Connection, Connection]]:
    with ExitStack() as stack:
        papers = {who: site.papers(who) for who in ("robot", "planner", "mallory")}

        def start(who: str, host: str, main, *args: Any) -> Connection:
            network = next(hosts for hosts in ADDRESSES.values() if {"door", host} <= {*hosts})
            door = f"tls/{network['door']}:{SECURE}"
            inside = site.host(host)
            return stack.enter_context(child(main, papers[who], site.policy, door, *args, inside=inside))

        robot = start("robot", "robot", _serve)
        hear(robot)
        planner = start("planner", "office", _plan)
        key = hear(planner)
        mallory = start("mallory", "lobby", _flood, key)
        hear(mallory)
        yield robot, planner, mallory


def _ask(pipe: Connection, request: object):
    pipe.send(request)
    return hear(pipe)


def _serve(pipe: Connection, papers: Path, policy: Path, door: str) -> None:
    from trade import service

    class Neck:
        ran = 0

        @service(effect="read")
        def angle(self) -> float:
            Neck.ran += 1
            return 0.5

        @service(effect="stop")
        def stop(self) -> None:
            Neck.ran += 1

    with _container("robot", papers, policy, door) as container:
        container.register(Neck(), _GROUP)
        pipe.send("up")
        while _heard(pipe):
            pipe.send(Neck.ran)


def _plan(pipe: Connection, papers: Path, policy: Path, door: str) -> None:
    from trade import where

    with _container("planner", papers, policy, door) as container:
        angle = container.find(where(name="angle", group=_GROUP), wait_s=20).with_(deadline_s=_PATIENCE_S)
        stop = container.find(where(name="stop", group=_GROUP)).with_(deadline_s=_PATIENCE_S)
        angle(), stop()
        key = angle.key
        pipe.send(f"{key.address}/{key.domain}/{key.provider}")
        while n := _heard(pipe):
            felt, until = list[tuple[float, float]](), time.monotonic() + _ROUND_S
            while len(felt) < n and time.monotonic() < until:
                felt.append((_took_ms(angle), _took_ms(stop)))
            pipe.send(tuple(zip(*felt, strict=True)))


def _took_ms(call) -> float:
    from trade.errors import TradeError

    began = time.perf_counter()
    try:
        call()
    except TradeError:
        return math.inf
    return (time.perf_counter() - began) * 1e3


def _flood(pipe: Connection, papers: Path, policy: Path, door: str, callee: str) -> None:
    with bare_session([f"tls/127.0.0.1:{_PORT}"], [door], papers, policy, namespace=SYSTEM[SECURE]) as session:
        pipe.send("up")
        while flood := _heard(pipe):
            ended, sent = threading.Event(), [0.0]
            thread = threading.Thread(target=_put_all, args=(session, flood, callee, ended, sent))
            thread.start()
            pipe.send("begun")
            _heard(pipe)
            ended.set()
            thread.join()
            pipe.send(sent[0])


def _put_all(session, flood: Flood, callee: str, ended: threading.Event, sent_hz: list[float]) -> None:
    import zenoh

    cc, rt = zenoh.CongestionControl, zenoh.Priority
    key = session.declare_keyexpr(f"{flood.kind}/mallory/{callee}")
    publisher = session.declare_publisher(
        key,
        congestion_control=cc.BLOCK if flood.waits else cc.DROP,
        express=flood.waits,
        priority=rt.REAL_TIME if flood.kind == "stop" else rt.DATA,
    )
    message = _junk if flood.junk else _call
    count, began = 0, time.monotonic()
    while not ended.is_set():
        due = int(RATE_HZ * (time.monotonic() - began))
        while count < min(due, count + RATE_HZ * _TICK_S):
            publisher.put(message(count, flood.kind))
            count += 1
        ended.wait(_TICK_S)
    sent_hz[0] = count / (time.monotonic() - began)
    publisher.undeclare()
    session.undeclare(key)


def _call(number: int, kind: str) -> bytes:
    from msgspec import Raw

    from trade.protocol.messages import PROTOCOL, Call, encode_message

    service = "stop" if kind == "stop" else "angle"
    return encode_message(Call(PROTOCOL, number + 1, service, "m/e-0", "mallory/m/e", None, (), Raw(b"\x90")))


def _junk(_number: int, _kind: str) -> bytes:
    return b"\xff" * 64


def _container(name: str, papers: Path, policy: Path, door: str):
    from trade import Container, Settings

    return Container(
        Settings.read(
            system=SYSTEM[SECURE], container=name, listen=["tls/127.0.0.1:0"], connect=[door], tls=papers, policy=policy
        )
    )


def _heard(pipe: Connection):
    """What is asked next; nothing at the end."""
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return None


def _print(results: Mapping[str, Sequence[Felt]], n: int) -> None:
    print(f"\none identity floods through the gateway, at most {RATE_HZ} a second; another one's calls and stops, ms")
    print(
        f"medians over {len(results[_QUIET])} rounds of {n} each at most; lost: not answered within {_PATIENCE_S:.0f} s"
    )
    print(f"{'':20}{'call p50':>9}{'p99':>8}{'stop p50':>10}{'p99':>8}{'most':>8}{'lost':>6}{'sent/s':>9}{'ran/s':>8}")
    for name, rounds in results.items():
        times = [[_at(half, one.call_ms) for one in rounds] for half in (50, 99)]
        times += [[_at(q, one.stop_ms) for one in rounds] for q in (50, 99, 100)]
        lost = sum(ms == math.inf for one in rounds for ms in (*one.call_ms, *one.stop_ms))
        rates = [statistics.median(getattr(one, what) for one in rounds) for what in ("sent_hz", "ran_hz")]
        widths = (9, 8, 10, 8, 8)
        shown = "".join(f"{statistics.median(x):{w}.1f}" for x, w in zip(times, widths, strict=True))
        _keep(name, rounds)
        print(f"{name:20}{shown}{lost:6}{rates[0]:9.0f}{rates[1]:8.0f}")
    quiet = results[_QUIET]
    for flood in FLOODS:
        felt = results[flood.name]
        if flood.kind == "stop":  # calls come after stops everywhere, but in time for a lock to be renewed
            p99_ms = [_at(99, one.call_ms) for one in felt]
            limit = f"below {_MOST_CALL_MS:.0f}"
            print_target(f"{flood.name}: call p99, ms", p99_ms, limit, lambda ms: ms < _MOST_CALL_MS)
        else:
            x = [_at(99, one.call_ms) / _at(99, other.call_ms) for one, other in zip(felt, quiet, strict=True)]
            limit = f"below {_MOST_TIMES_P99:.0f}"
            print_target(f"{flood.name}: call p99 / none", x, limit, lambda x: x < _MOST_TIMES_P99)
        most = [max(one.stop_ms) for one in felt]
        print_target(f"{flood.name}: stop, ms", most, f"below {_MOST_STOP_MS:.0f}", lambda ms: ms < _MOST_STOP_MS)


def _keep(name: str, rounds: Sequence[Felt]) -> None:
    values = {
        "call p50, ms": [_at(50, one.call_ms) for one in rounds],
        "call p99, ms": [_at(99, one.call_ms) for one in rounds],
        "stop p50, ms": [_at(50, one.stop_ms) for one in rounds],
        "stop most, ms": [max(one.stop_ms) for one in rounds],
        "put/s": [one.sent_hz for one in rounds],
    }
    keep_point("beside a flood", name, sum(len(one.call_ms) for one in rounds), values)


def _at(percent: int, values: Sequence[float]) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(percent / 100 * len(ordered)) - 1)]
