"""What a run of the bench leaves, as JSON: its points, its targets, where and how it ran."""

import os
import platform
import subprocess
import time
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from statistics import median, quantiles
from typing import Any, Final

import psutil
from msgspec import Struct, field, json, structs

_ROOT: Final = Path(__file__).parents[2]
_LIBRARIES: Final = ("eclipse-zenoh", "msgspec", "rpyc", "Pyro5", "grpcio", "ur-rtde")
_QUIET_CORES: Final = 0.1
NEVER: Final = 1e12
"""For what did not happen: JSON has no infinity."""


class Spread(Struct, frozen=True, array_like=True):
    """One figure over the rounds of a run."""

    median: float
    low: float
    """A quarter of the rounds is below it,"""
    high: float
    """and a quarter above this."""
    least: float
    most: float
    rounds: int

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Rounded to four digits: more is noise. What is infinite becomes `NEVER`."""
        values = [min(value, NEVER) for value in values]
        low, _, high = quantiles(values, n=4, method="inclusive") if len(values) > 1 else 3 * [values[0]]
        figures = (float(f"{x:.4g}") for x in (median(values), low, high, min(values), max(values)))
        return cls(*figures, rounds=len(values))

    @property
    def width(self) -> float:
        return self.high - self.low


class Histogram(Struct, frozen=True):
    """How many of one thing's figures lie where."""

    edges: tuple[float, ...]
    """Ascending; a figure that is one of them lies above it."""
    counts: tuple[int, ...]
    """Below the first edge, between each and the next, above the last."""

    @classmethod
    def of(cls, values: Sequence[float], edges: Sequence[float]) -> "Histogram":
        counts = [0] * (len(edges) + 1)
        for value in values:
            counts[bisect_right(edges, value)] += 1
        return cls(tuple(edges), tuple(counts))


class Point(Struct, frozen=True, omit_defaults=True):
    """What was measured of one thing."""

    part: str
    case: str
    """Under which it was; points of one case stand in one table."""
    name: str
    n: int
    """Calls, cycles or samples, of all rounds; 0 where there is nothing to count."""
    values: dict[str, Spread]
    """By what was measured, with its unit; ``p50 / bare`` and the like are ratios to another point's same round."""
    histogram: Histogram | None = None
    """Of what was measured one by one, where its distribution is the point."""


class Target(Struct, frozen=True):
    """What was asked, and what came of it."""

    part: str
    name: str
    asked: str
    measured: Spread
    met: bool


class Skipped(Struct, frozen=True):
    """What was not measured."""

    part: str
    name: str
    reason: str


class Machine(Struct, frozen=True):
    """Where a run was."""

    processor: str
    cores: int
    memory_gib: float
    system: str
    python: str

    @classmethod
    def here(cls) -> "Machine":
        return cls(
            processor=_processor(),
            cores=psutil.cpu_count() or 1,
            memory_gib=round(psutil.virtual_memory().total / 1024**3, 1),
            system=f"{platform.system()} {platform.release()} {platform.machine()}",
            python=f"{platform.python_implementation()} {platform.python_version()}",
        )


class Again(Struct, frozen=True):
    """When some parts of a run were measured again."""

    parts: tuple[str, ...]
    commit: str
    began: str
    arguments: tuple[str, ...]
    others_cores: float | None


class Run(Struct):
    """A run. ``others_cores`` is how many cores other programs took meanwhile, on average; None until it has ended."""

    machine: Machine
    versions: dict[str, str]
    commit: str
    began: str
    arguments: list[str]
    load_before: float
    """The load average over a minute."""
    load_after: float | None = None
    took_s: float | None = None
    others_cores: float | None = None
    points: list[Point] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)
    again: list[Again] = field(default_factory=list)

    @classmethod
    def begin(cls, arguments: Sequence[str] = ()) -> "Run":
        return cls(
            machine=Machine.here(),
            versions=_versions(),
            commit=_commit(),
            began=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
            arguments=list(arguments),
            load_before=round(os.getloadavg()[0], 2),
        )

    @classmethod
    def read(cls, file: Path) -> "Run":
        """Raises OSError, and msgspec.DecodeError or msgspec.ValidationError of what is no run."""
        return json.decode(file.read_bytes(), type=cls)

    def write(self, file: Path) -> None:
        """A line for each point and target, so that a difference can be read."""
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(json.encode(self).replace(b"},{", b"},\n{") + b"\n")

    def amended(self, newer: "Run") -> "Run":
        """This run with all that the newer one measured, or could not, in the place of what is here of its parts."""
        measured = tuple(dict.fromkeys((*newer.parts(), *(one.part for one in newer.skipped))))
        order = {part: at for at, part in enumerate(dict.fromkeys((*self.parts(), *measured)))}

        def of(kind: str) -> list[Any]:
            old = [one for one in getattr(self, kind) if one.part not in measured]
            return sorted([*old, *getattr(newer, kind)], key=lambda one: order.get(one.part, len(order)))

        reported = Again(measured, newer.commit, newer.began, tuple(newer.arguments), newer.others_cores)
        kept = [one for one in self.again if not set(one.parts) <= set(measured)]
        lists = {kind: of(kind) for kind in ("points", "targets", "skipped")}
        return structs.replace(self, again=[*kept, reported], **lists)

    @property
    def quiet(self) -> bool:
        """Whether other programs hardly ran."""
        return self.others_cores is not None and self.others_cores <= _QUIET_CORES

    @property
    def missed(self) -> list[Target]:
        return [target for target in self.targets if not target.met]

    def parts(self) -> Iterator[str]:
        """Those that measured something, in their order."""
        return iter(dict.fromkeys(one.part for one in (*self.points, *self.targets)))


class Clock:
    """What has passed since a run began, and how much of the machine others took."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()
        self._busy_s, self._own_s = _busy_s(), _own_s()

    def stop(self, run: Run) -> None:
        """Write it down. Children that have not been waited for are taken for others."""
        took_s = time.monotonic() - self._began_s
        others_s = _busy_s() - self._busy_s - (_own_s() - self._own_s)
        run.took_s = round(took_s, 1)
        run.others_cores = round(max(0.0, others_s / took_s), 2)
        run.load_after = round(os.getloadavg()[0], 2)


def _busy_s() -> float:
    """Processor time of the whole machine."""
    times = psutil.cpu_times()
    return sum(getattr(times, kind, 0.0) for kind in ("user", "nice", "system", "irq", "softirq", "steal"))


def _own_s() -> float:
    """Of this process and the children that ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("model name", "Model")):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _versions() -> dict[str, str]:
    found: dict[str, str] = {}
    for name in _LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def _commit() -> str:
    """The commit this is, marked where files differ from it; empty outside a repository."""
    words = ("git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    try:
        return subprocess.run(words, cwd=_ROOT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
