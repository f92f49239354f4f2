"""Which threads a call costs processor time: ``python -m tests.bench.threads``, for the reasons in why.toml. Linux.

For each peer it prints, of every thread of both ends, the processor time of a call and how often the thread went to
sleep. Threads of one name are added up: those of zenoh are called rx, tx, acc and net; Python's have no names of
their own.
"""

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import psutil

from tests.bench._calls import up
from tests.bench._children import Job, Running
from tests.bench._peers import BarePair
from tests.bench._trade import Trade, TradeThreads

_PEERS: Final = (BarePair(), Trade(), TradeThreads())
_LEAST_US: Final = 0.5


class Spent(NamedTuple):
    """By one thread since it began, or by several."""

    cpu_ns: int
    sleeps: int


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.threads", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, default=5000, help="calls of each peer (%(default)s)")
    parser.add_argument("--size", type=int, default=64, help="bytes of a call (%(default)s)")
    parser.add_argument("--in-flight", type=int, default=1, help="calls under way (%(default)s)")
    options = parser.parse_args()
    job = Job(options.size, options.n, options.in_flight)
    for peer in _PEERS:
        _measure(peer, job)


def _measure(peer: BarePair | Trade, job: Job) -> None:
    with up([peer]) as [running]:
        ends = [each for each in psutil.Process().children() if "spawn_main" in " ".join(each.cmdline())]
        running.run(job)  # a first round for caches and connections; not counted
        _print(running, dict(zip(("server", "caller"), (each.pid for each in ends), strict=True)), job)


def _print(peer: Running, ends: Mapping[str, int], job: Job) -> None:
    before = {end: dict(_threads(pid)) for end, pid in ends.items()}
    took = peer.run(job)
    print(f"\n{peer.name}: {job.n} calls of {job.size} B, {job.in_flight} under way; {took.cpu_us:.0f} us of CPU each")
    for end, pid in ends.items():
        total: dict[str, Spent] = {}
        for (number, name), now in _threads(pid):
            was, so_far = before[end].get((number, name), Spent(0, 0)), total.get(name, Spent(0, 0))
            total[name] = Spent(so_far.cpu_ns + now.cpu_ns - was.cpu_ns, so_far.sleeps + now.sleeps - was.sleeps)
        for name, spent in sorted(total.items(), key=lambda one: -one[1].cpu_ns):
            if (us := spent.cpu_ns / job.n / 1e3) >= _LEAST_US:
                print(f"  {end:8}{name:16}{us:8.1f} us{spent.sleeps / job.n:8.2f} sleeps")


def _threads(pid: int) -> Iterator[tuple[tuple[str, str], Spent]]:
    """Those of a process, by number and name."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            cpu_ns = int((task / "schedstat").read_text().split()[0])
            status = (task / "status").read_text()
            name = (task / "comm").read_text().strip()
        except FileNotFoundError:  # it has ended
            continue
        [sleeps] = (int(line.split()[1]) for line in status.splitlines() if line.startswith("voluntary"))
        main = name + (", main" if task.name == str(pid) else "")
        yield (task.name, main), Spent(cpu_ns, sleeps)


if __name__ == "__main__":
    main()
