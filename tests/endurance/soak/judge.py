"""The judge of a soak: a pure function from samples of processes and what planners said to what was wrong."""

import itertools
import statistics
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from msgspec import Struct

from tests.support.lock_log import Verdict

MOST_MIB: Final = 8.0
"""How much the memory of a process may grow between the second quarter of a run and the last one."""
MOST_FILES, MOST_THREADS = 4, 4
"""The same of open files and of threads; a short-lived container has some at that moment."""
_SILENT_S: Final = 120.0
"""A planner that completed no round in so long is stuck."""
_QUARTERS: Final = 4
_SILENT: Final = ("DeviceSilent: ", "MotionStopped: ")
_RELAXED: Final = ("watchdog", "for too long", "it was away", "lost its activation", "is not activated")
"""A driver that was held up holds what moves, and says so; a device that missed it may have stopped by itself."""


class Sample(Struct, frozen=True):
    """What one process has at a moment."""

    t: float
    process: str
    pid: int
    rss_mib: float
    files: int
    threads: int
    cpu_s: float


class Said(Struct, frozen=True):
    """What a planner did up to a moment, as it says itself."""

    t: float
    planner: str
    counts: dict[str, int]
    errors: dict[str, int]
    p50_us: float = 0.0
    p99_us: float = 0.0


class Run(Struct):
    """All that was noted; times in seconds since its begin."""

    seconds: float = 0.0
    samples: list[Sample] = []
    said: list[Said] = []
    passers: int = 0
    """Who came and went."""
    complaints: list[str] = []
    """What went wrong with those who pass by, and in the end."""
    patience: float = 0.0
    """In so many of all rounds a device may have been silent, as it is to a driver that got no processor."""


def judge(run: Run) -> Verdict:
    """Look for growth, for processes that were replaced, for errors, and for who stood still."""
    verdict = Verdict()
    verdict.counts["passers"] = run.passers
    verdict.violations += run.complaints
    for planner, said in _by_planner(run.said).items():
        verdict.counts.update({f"{planner}: {what}": count for what, count in said[-1].counts.items()})
        verdict.counts[f"{planner}: errors"] = sum(said[-1].errors.values())
        verdict.violations += _errors(planner, said[-1], run.patience)
        verdict.violations += [f"{planner} {what}" for what in _stood_still(said, run.seconds)]
    for process, samples in by_process(run.samples).items():
        verdict.violations += [f"{process} {what}" for what in _grown(samples, run.seconds)]
        if pids := {sample.pid for sample in samples} - {samples[0].pid}:
            verdict.violations.append(f"{process} was started again {len(pids)} times")
    return verdict


def by_process(samples: Sequence[Sample]) -> Mapping[str, list[Sample]]:
    """In the order of time."""
    found: dict[str, list[Sample]] = defaultdict(list)
    for sample in samples:
        found[sample.process].append(sample)
    return found


def _errors(planner: str, last: Said, patience: float) -> Iterator[str]:
    silent = {error: count for error, count in last.errors.items() if _lost(error)}
    few = sum(silent.values()) <= patience * last.counts.get("rounds", 0)
    for error, count in last.errors.items():
        if not (few and error in silent):
            yield f"{planner}: {error} ({count} times)"


def _lost(error: str) -> bool:
    """Whether it says that a device was silent for a moment, or what came of that."""
    return error.startswith(_SILENT) or (error.startswith("DeviceFault: ") and any(word in error for word in _RELAXED))


def _by_planner(said: Sequence[Said]) -> Mapping[str, list[Said]]:
    found: dict[str, list[Said]] = defaultdict(list)
    for each in said:
        found[each.planner].append(each)
    return found


def growth(samples: Sequence[Sample], seconds: float) -> dict[str, float]:
    """How much more there is in the last quarter than in the second, by medians; nothing if one was not seen."""
    quarter = seconds / _QUARTERS
    early = [sample for sample in samples if quarter <= sample.t < 2 * quarter]
    late = [sample for sample in samples if sample.t >= 3 * quarter]
    if not early or not late:
        return {}
    kinds = ("rss_mib", "files", "threads")
    return {
        kind: statistics.median(getattr(sample, kind) for sample in late)
        - statistics.median(getattr(sample, kind) for sample in early)
        for kind in kinds
    }


def _grown(samples: Sequence[Sample], seconds: float) -> Iterator[str]:
    more = growth(samples, seconds)
    if not more:
        yield "was not there all the time"
        return
    if more["rss_mib"] > MOST_MIB:
        yield f"grew by {more['rss_mib']:.1f} MiB"
    if more["files"] > MOST_FILES:
        yield f"has {more['files']:.0f} more files open"
    if more["threads"] > MOST_THREADS:
        yield f"has {more['threads']:.0f} more threads"


def _stood_still(said: Sequence[Said], seconds: float) -> Iterator[str]:
    done = [0.0]  # when another round was done
    rounds = 0
    for each in said:
        if each.counts.get("rounds", 0) > rounds:
            rounds = each.counts["rounds"]
            done.append(each.t)
    for earlier, later in itertools.pairwise([*done, seconds]):
        if later - earlier > _SILENT_S:
            yield f"did nothing from {earlier:.0f} s to {later:.0f} s"
