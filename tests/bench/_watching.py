"""Notifications and hooks: a thousand ``every``, and what watching a service costs it."""

import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Final

from tests.bench._alone import alone
from tests.bench._places import own_folder
from tests.bench._report import keep_point, print_target

_SYSTEM: Final = "bench-watching"
_TICKS, _PERIOD_S = 1000, 0.1
_MOST_MERGED: Final = 1.0
_NONE, _ELSEWHERE, _HOOKED = "not watched", "another is watched", "watched"
_MOST_ELSEWHERE: Final = 1.05


def run(n: int, rounds: int, seconds: float) -> None:
    """Measure and print.

    Args:
        n: calls in a round.
        rounds: how often each kind has its turn.
        seconds: how long the notifications stand.
    """
    with own_folder():
        merged, cpu = alone(_measure_ticks, seconds)
        results = alone(_measure_hooks, n, rounds)
    print(f"\n{_TICKS} notifications, each every {_PERIOD_S:g} s, for {seconds:g} s: {cpu:.0f} % of a core")
    keep_point(
        f"{_TICKS} notifications", f"every {_PERIOD_S:g} s", _TICKS, {"% of a core": [cpu], "merged, %": [merged]}
    )
    print_target("merged ticks, %", [merged], f"below {_MOST_MERGED:g}", lambda share: share < _MOST_MERGED)
    print(f"a call in the same container: medians over {rounds} rounds of {n}")
    for name, us in results.items():
        print(f"{name:20}{median(us):8.1f} us")
        keep_point("a call in the same container", name, n * rounds, {"p50, us": us})
    shares = [other / none for other, none in zip(results[_ELSEWHERE], results[_NONE], strict=True)]
    target = f"at most {_MOST_ELSEWHERE:g}"
    print_target("another watched / none", shares, target, lambda share: share <= _MOST_ELSEWHERE)


def _measure_ticks(seconds: float) -> tuple[float, float]:
    """Per cent of ticks that were merged, and of a core that all took."""
    from trade import Container, Settings

    def nothing() -> None:
        """What is done at each tick."""

    with Container(Settings.read(container="clock", system=_SYSTEM)) as container:
        standing = [container.every(_PERIOD_S, nothing) for _ in range(_TICKS)]
        cpu_s, began_s = time.process_time(), time.monotonic()
        time.sleep(seconds)
        cpu = (time.process_time() - cpu_s) / (time.monotonic() - began_s) * 100
        infos = [one.info() for one in standing]
    fired, merged = sum(info.fired for info in infos), sum(info.merged for info in infos)
    return merged / max(1, fired + merged) * 100, cpu


def _measure_hooks(n: int, rounds: int) -> dict[str, list[float]]:
    from trade import Container, HookEvent, Settings, service

    class Lamp:
        @service(effect="read")
        def brightness(self) -> float:
            return 0.5

    class Watch:
        @service(effect="read")
        def see(self, called: HookEvent) -> None:
            """Nothing is done with it."""

    with Container(Settings.read(container="hall", system=_SYSTEM)) as container:
        [lamp], [other], [see] = (
            container.register(one, group) for one, group in ((Lamp(), "a"), (Lamp(), "b"), (Watch(), "c"))
        )
        results: dict[str, list[float]] = {name: [] for name in (_NONE, _ELSEWHERE, _HOOKED)}
        for i in range(rounds):
            results[_NONE].append(_p50_us(lamp, n))
            for name, target in ((_ELSEWHERE, other), (_HOOKED, lamp)):
                hook = container.after_service(target, see)
                results[name].append(_p50_us(lamp, n))
                hook.detach()
            print(f"watching: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
        return results


def _p50_us(do: Callable[[], object], n: int) -> float:
    took_us: list[float] = []
    for _ in range(n):
        began = time.perf_counter_ns()
        do()
        took_us.append((time.perf_counter_ns() - began) / 1e3)
    return median(took_us)
