"""A call of a service in the same container, of three numbers: with the copies a wire would make, and without."""

import itertools
import sys
import time
from collections.abc import Callable
from contextvars import ContextVar
from statistics import median
from typing import TYPE_CHECKING, Final

from msgspec import Struct
from msgspec.structs import force_setattr

from tests.bench._alone import alone
from tests.bench._places import own_folder
from tests.bench._report import keep_point, print_target

if TYPE_CHECKING:
    from trade import GroupView

_MOST_US: Final = 5.0
_MOST_OF_BARE: Final = 3
_MOST_RATIO: Final = 1.05
_PLAIN, _BARE = "plain method", "bare context"
_STRICT, _LENIENT, _ATTRIBUTE = "strict", "strict=False", "strict, attribute"

Results = dict[str, list[float]]


class _Permit(Struct, eq=False):
    """What a call may do at a resource."""

    call_id: int
    sessions: tuple[str, ...]
    fences: list[tuple[object, int, int]] = []


def run(n: int, rounds: int) -> None:
    """Measure and print.

    Args:
        n: calls of each kind in a round.
        rounds: how often each kind has its turn.
    """
    with own_folder():
        results = alone(_measure, n, rounds)
    print(f"\nlocal call of three numbers: medians over {rounds} rounds of {n} calls")
    for name, us in results.items():
        print(f"{name:16}{median(us):8.2f} us")
        keep_point("a call of three numbers", name, n * rounds, {"us": us})
    strict, lenient = results[_STRICT], results[_LENIENT]
    print_target("local, strict: us a call", strict, f"at most {_MOST_US:.0f}", lambda us: us <= _MOST_US)
    shares = [own / bare for own, bare in zip(lenient, results[_BARE], strict=True)]
    print_target("local, not strict / bare context", shares, f"at most {_MOST_OF_BARE}", lambda x: x <= _MOST_OF_BARE)
    ratios = [attribute / handle for attribute, handle in zip(results[_ATTRIBUTE], strict, strict=True)]
    print_target("local: attribute / handle", ratios, f"at most {_MOST_RATIO}", lambda ratio: ratio <= _MOST_RATIO)


def _measure(n: int, rounds: int) -> Results:
    from trade import Container, Settings

    with Container(Settings.read(container="alone", system="bench-local")) as container:
        plain = _arm(strict=True)
        calls = {
            _PLAIN: plain.move,
            _BARE: _in_bare_context(plain.move),
            _STRICT: container.register(plain, "bench.arm")[0],
            _LENIENT: container.register(_arm(strict=False), "bench.lenient")[0],
        }
        arm = container.robot("bench").arm
        results: Results = {name: [] for name in (*calls, _ATTRIBUTE)}
        for i in range(rounds):
            results[_ATTRIBUTE].append(_us_per_attribute(arm, n))
            for name, call in calls.items():
                results[name].append(_us_per_call(call, n))
            print(f"local: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
        return results


def _arm(*, strict: bool):
    from trade import service

    class Arm:
        @service(strict=strict)
        def move(self, shoulder_rad: float, elbow_rad: float, speed_rad_s: float) -> float:
            return shoulder_rad

    return Arm()


def _in_bare_context(method: Callable[..., float]) -> Callable[..., float]:
    """The method with what a local call needs at least, without any layer between: a context with a deadline, found by
    the code that runs; its resource, which knows the call until it ends, so that a stop or a lock finds it; and what
    the driver compares before bytes go out, read after that. No registry and no right is looked up.
    """
    from trade import Resource
    from trade._context.call_context import CallContext

    running, ids = ContextVar[CallContext | None]("bench", default=None), itertools.count()
    resource = Resource("bench.arm")

    def call(*args: float) -> float:
        if running.get() is not None:
            raise RuntimeError("a nested call inherits its context")
        expires_ns = time.monotonic_ns() + 10**10
        context = CallContext(next(ids), "bench.arm.move", "me", "me/alone/epoch", expires_ns)
        resource.calls[context.id] = permit = _Permit(context.id, (context.session,))
        try:
            permit.fences.append((resource, resource.live, resource.stops))
            if (
                resource.pending is not None
                or resource.live
                or resource.latch is not None
                or resource.estop is not None
            ):
                raise RuntimeError("it is locked or stopped")
            resource.movers = permit.sessions
            force_setattr(context, "permit", permit)
            token = running.set(context)
            try:
                return method(*args)
            finally:
                running.reset(token)
        finally:
            del resource.calls[context.id]

    return call


def _us_per_attribute(arm: "GroupView", n: int) -> float:
    arm.move(0.1, 0.2, 0.3)
    began = time.perf_counter_ns()
    for _ in range(n):
        arm.move(0.1, 0.2, 0.3)
    return (time.perf_counter_ns() - began) / 1e3 / n


def _us_per_call(call: Callable[[float, float, float], float], n: int) -> float:
    call(0.1, 0.2, 0.3)
    began = time.perf_counter_ns()
    for _ in range(n):
        call(0.1, 0.2, 0.3)
    return (time.perf_counter_ns() - began) / 1e3 / n
