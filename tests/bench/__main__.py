"""Speed as ratios against peers in the same run. Numbers are printed, never asserted.

parts:
  calls      one remote call at a time, of 64 B to 2 MiB: raw TCP, the bare transport, ours, rpyc, Pyro5, gRPC, rospy
  in-flight  the same with 32 calls under way: calls/s as a share of the bare transport's
  checks     what certificates and a policy, 1 and 10 hooks, and a lock that is held add to a call
  local      a call in the same container, of three numbers
  registry   10,000 services as a late joiner sees them: time, memory, finding one (--full: of 10,000 providers, too)
  deadman    how long a joint moves on after its client was killed or frozen
  locks      taking and giving back four services of two containers; what the checks of resources add to a call
  watching   a thousand notifications every 0.1 s; what hooks cost a call that has none
  audit      what an audit record costs a call; records a second
  gateway    calls through one gateway and two, certificates and policy on; floods; an idle one (root, iproute2)
  streams    what five listeners to a joint-state stream at 200 Hz cost its source, beside one
  servo      the Dynamixel driver against what a bus of 1 Mbaud can carry
  feetech    the same of the Feetech driver
  can        cycles of six CiA 402 drives near what 1 Mbit/s can carry: how many are late
  jitter     by how much the cycles of each kind of bus are off their period: quiet and under load, with and without
             SCHED_FIFO where the system allows it
  rosie      what all drivers of a robot take of a core, at the rates it is meant for
  supervisor what ten children cost their gateway; a driver that crashed until it serves again, beside a plain start;
             what the start of a driver with one bus takes, and its memory
scale      what joining, leaving, announcing and finding cost, by how many containers there are: in memory 100, with
             --full 1,000; and 50 processes (root, iproute2)
  hub        200 processes (without --full 100) with one link each, to a hub: at rest, and when one more joins (root,
             iproute2)
  arm        set-points a second that reach the controller of an arm, beside a bare loop of the vendor's library

Progress goes to stderr, tables and targets (met or missed) to stdout, all targets once more at the end. Peers that are
not installed are skipped. A part that fails is tried once more; if it fails again the others go on, and the exit
code is 1 in the end.
"""

import argparse
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from tests.bench import (
    _arm,
    _audit,
    _calls,
    _cans,
    _checks,
    _deadman,
    _feetech,
    _gateway,
    _jitter,
    _local,
    _locks,
    _plots,
    _registry,
    _rosie,
    _scale,
    _servo,
    _streams,
    _supervisor,
    _watching,
)
from tests.bench._crowd import run_behind_a_hub
from tests.bench._record import Clock, Run
from tests.bench._report import begin_part, forget_since, mark, print_all_targets, print_skipped, this_run

_SERVICES_EACH = 10
_JITTER_ROUNDS = 8
"""One in a thousand cycles is reported, so some thousands are needed."""


def _run_registry(options: argparse.Namespace) -> None:
    _registry.run(options.services // _SERVICES_EACH, _SERVICES_EACH, max(1, options.rounds // 2))
    if options.full:
        _registry.run(options.services, 1, 1)


_PARTS: Mapping[str, Callable[[argparse.Namespace], None]] = {
    "calls": lambda options: _calls.run(options.n, options.rounds),
    "in-flight": lambda options: _calls.run_in_flight(options.n, options.rounds),
    "checks": lambda options: _checks.run(options.n, options.rounds),
    "local": lambda options: _local.run(50 * options.n, options.rounds),
    "registry": _run_registry,
    "deadman": lambda options: _deadman.run(options.rounds),
    "locks": lambda options: _locks.run(options.n, options.rounds),
    "watching": lambda options: _watching.run(options.n, options.rounds, options.seconds),
    "audit": lambda options: _audit.run(options.n, options.rounds, options.seconds),
    "gateway": lambda options: _gateway.run(options.n, options.rounds, options.idle),
    "streams": lambda options: _streams.run(max(1, options.rounds // 2), 2 * options.seconds),
    "servo": lambda options: _servo.run(options.n, options.rounds, options.seconds),
    "feetech": lambda options: _feetech.run(options.n, options.rounds, options.seconds),
    "can": lambda options: _cans.run(max(1, options.rounds // 2), options.seconds),
    "jitter": lambda options: _jitter.run(_JITTER_ROUNDS * options.n),
    "rosie": lambda options: _rosie.run(max(1, options.rounds // 2), options.seconds),
    "supervisor": lambda options: _supervisor.run(max(1, options.rounds // 2), options.idle),
    "scale": lambda options: _scale.run(options.containers, options.idle),
    "hub": lambda options: run_behind_a_hub(min(options.containers, _MOST_BEHIND_A_HUB), options.idle),
    "arm": lambda options: _arm.run(max(1, options.rounds // 2), 2 * options.seconds),
}
_ATTEMPTS = 2
_MOST_BEHIND_A_HUB = 200
_QUICK = {"n": 250, "rounds": 8, "seconds": 1.5, "idle": 20.0, "containers": 100}
_FULL = {"n": 500, "rounds": 20, "seconds": 3.0, "idle": 60.0, "containers": 1000}


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="part", help=f"{', '.join(_PARTS)}; all of them by default")
    parser.add_argument("--full", action="store_true", help="longer rounds and more of them: about an hour")
    parser.add_argument("-n", type=int, help=f"calls or cycles in a round ({_QUICK['n']}, full {_FULL['n']})")
    parser.add_argument("--rounds", type=int, help=f"turns of each peer ({_QUICK['rounds']}, full {_FULL['rounds']})")
    parser.add_argument(
        "--seconds", type=float, help="length of a round of the servo bus at 100 Hz, and of a trajectory on the CAN bus"
    )
    parser.add_argument(
        "--idle", type=float, help=f"seconds for an idle gateway ({_QUICK['idle']}, full {_FULL['idle']})"
    )
    parser.add_argument(
        "--containers",
        type=int,
        help=f"at most, of the parts scale and hub ({_QUICK['containers']}, full {_FULL['containers']})",
    )
    parser.add_argument("--services", type=int, default=10_000, help="of the registry part (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured, for compare and page")
    parser.add_argument("--into", type=Path, metavar="RUN", help="an earlier run, whose other parts are kept")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page with plots of it")
    options = parser.parse_args()
    if unknown := set(options.parts) - set(_PARTS):
        parser.error(f"there is no part {', '.join(unknown)}; there are {', '.join(_PARTS)}")
    for name, default in (_FULL if options.full else _QUICK).items():
        if getattr(options, name) is None:
            setattr(options, name, default)
    sys.exit(_run(options))


def _run(options: argparse.Namespace) -> int:
    """All parts that are asked for; gives how many failed, at most one. What is measured is written after each."""
    clock, run, failed = Clock(), this_run(), 0
    earlier = Run.read(options.into) if options.into else None
    run.arguments = _without_files(sys.argv[1:])
    for part in _PARTS:
        if options.parts and part not in options.parts:
            continue
        begin_part(part)
        failed |= not _succeeds(part, options)
        clock.stop(run)
        if options.json:
            (earlier.amended(run) if earlier else run).write(options.json)
        if options.html:
            options.html.parent.mkdir(parents=True, exist_ok=True)
            options.html.write_text(_plots.page(run))
    print_all_targets()
    return failed


def _succeeds(part: str, options: argparse.Namespace) -> bool:
    """Run a part, and once more if it fails: a busy machine loses devices. Of a failure its reason is left."""
    for attempt in range(_ATTEMPTS):
        before = mark()
        try:
            _PARTS[part](options)
        except Exception as bad:  # noqa: BLE001 - what the other parts measured is not lost with it
            traceback.print_exc()
            forget_since(before)
            if attempt == _ATTEMPTS - 1:
                print_skipped(part, f"it failed: {type(bad).__name__}: {bad}")
        else:
            return True
    return False


def _without_files(words: Sequence[str]) -> list[str]:
    """Where a run is written is no part of what it is."""
    return [word for before, word in pairwise(["", *words]) if not {before, word} & {"--json", "--html", "--into"}]


if __name__ == "__main__":
    main()
