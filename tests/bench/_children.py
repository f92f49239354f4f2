"""A peer in two processes, its server and its caller, controlled over pipes; both end with the block."""

import ctypes
import multiprocessing
import os
import random
import statistics
import subprocess
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from tests.bench._links import Link, Peer, check

_SPAWN = multiprocessing.get_context("spawn")
_ROOT = Path(__file__).parents[2]
_PATIENCE_S = 60.0
_END_S = 5.0
_NETWORK = 0x40000000
"""CLONE_NEWNET of setns(2): os.setns came with Python 3.12."""


@dataclass(frozen=True, slots=True)
class Job:
    """What a caller has to do in a round."""

    size: int
    n: int
    in_flight: int = 1


@dataclass(frozen=True, slots=True)
class Round:
    """What one peer took for a round of calls."""

    p50_us: float
    p99_us: float
    calls_per_s: float
    cpu_us: float
    """Per call, of both processes together."""


class Running:
    """A peer whose processes are up."""

    def __init__(self, peer: Peer, server: Connection, caller: Connection) -> None:
        self.name = peer.name
        self.least_bytes = peer.least_bytes
        self.most_bytes = peer.most_bytes
        self._server = server
        self._caller = caller

    def run(self, job: Job) -> Round:
        """A round. Of calls that overlap only their rate is known: p50 and p99 are those of a mean call."""
        before_ns = _ask(self._server, "cpu")
        took_ns, caller_ns = _ask(self._caller, job)
        server_ns = _ask(self._server, "cpu") - before_ns
        took_us = [ns / 1e3 for ns in took_ns]
        p99_us = statistics.quantiles(took_us, n=100)[98] if len(took_us) > 1 else took_us[0]
        return Round(
            statistics.median(took_us), p99_us, 1e6 / statistics.fmean(took_us), (caller_ns + server_ns) / 1e3 / job.n
        )


@contextmanager
def running(peer: Peer) -> Iterator[Running]:
    """Start both processes of a peer. Raises RuntimeError if one of them does not come up."""
    with (
        _child_of(peer, peer.server_at, _serve, peer) as server,
        _child_of(peer, peer.caller_at, _call, peer, hear(server)) as caller,
    ):
        hear(caller)
        yield Running(peer, server, caller)


def _child_of(peer: Peer, inside: str, main, *args: object) -> AbstractContextManager[Connection]:
    return _elsewhere(peer.python, main, *args) if peer.python else child(main, *args, inside=inside)


@contextmanager
def _elsewhere(python: str, main, *args: object) -> Iterator[Connection]:
    """The same under another Python, which sees this repository and only its own libraries."""
    ours, theirs = _SPAWN.Pipe()
    code = f"from tests.bench._children import begin; begin({theirs.fileno()})"
    others = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment = {**others, "PYTHONPATH": str(_ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.Popen([python, "-c", code], env=environment, pass_fds=[theirs.fileno()])
    theirs.close()
    try:
        ours.send((main, args))
        yield ours
    finally:
        ours.close()  # which ends it
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def begin(pipe: int) -> None:
    """What such a process does first: hear what it is for, on a pipe of this number."""
    reported = Connection(pipe)
    main, args = reported.recv()
    main(reported, *args)


@contextmanager
def child(main, *args: object, inside: str = "") -> Iterator[Connection]:
    """A process that runs ``main(pipe, *args)``, in a network namespace if one is named, and our end of the pipe."""
    ours, theirs = _SPAWN.Pipe()
    process = _SPAWN.Process(target=_run, args=(inside, main, theirs, *args), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ours
    finally:
        ours.close()  # which ends it
        process.join(_END_S)
        if process.is_alive():
            process.kill()
            process.join()


def _run(inside: str, main, *args: object) -> None:
    if inside:
        _enter(Path("/run/netns") / inside)
        # Another host has another folder: calls between the two would take the local path else.
        os.environ["TRADE_RUNTIME_DIR"] = str(Path(os.environ["TRADE_RUNTIME_DIR"]) / inside)
    main(*args)


def _enter(namespace: Path) -> None:
    """Go into a network namespace: this thread, and all it starts. Raises OSError."""
    with namespace.open("rb") as place:
        if ctypes.CDLL(None, use_errno=True).setns(place.fileno(), _NETWORK):
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), str(namespace))


def _serve(pipe: Connection, peer: Peer) -> None:
    with peer.serve() as address:
        pipe.send(address)
        for _ in _requests(pipe):
            pipe.send(time.process_time_ns())


def _call(pipe: Connection, peer: Peer, address: str) -> None:
    with peer.connect(address) as link:
        pipe.send("ready")
        for job in _requests(pipe):
            pipe.send(_round(link, job))


def _round(link: Link, job: Job) -> tuple[list[float], int]:
    """How long each call took (or the mean one, if they overlap), and this process's CPU time for all; in ns."""
    payload = random.Random(0).randbytes(job.size)  # nothing that a library could compress
    spent_ns = time.process_time_ns()
    if job.in_flight == 1:
        took_ns = [_timed(link, payload) for _ in range(job.n)]
    else:
        began = time.perf_counter_ns()
        link.burst(payload, job.n, job.in_flight)
        took_ns = [(time.perf_counter_ns() - began) / job.n]
    return took_ns, time.process_time_ns() - spent_ns


def _timed(link: Link, payload: bytes) -> float:
    began = time.perf_counter_ns()
    answer = link.call(payload)
    took_ns = time.perf_counter_ns() - began
    check(payload, answer)
    return took_ns


def _requests(pipe: Connection) -> Iterator:
    while True:
        try:
            yield pipe.recv()
        except (EOFError, OSError):  # the parent is done with us
            return


def _ask(pipe: Connection, request: object):
    pipe.send(request)
    return hear(pipe)


def hear(pipe: Connection, patience_s: float = _PATIENCE_S):
    """What a child says next. Raises RuntimeError if it says nothing, or has ended."""
    if not pipe.poll(patience_s):
        raise RuntimeError(f"a child process said nothing for {patience_s} s")
    try:
        return pipe.recv()
    except EOFError:
        raise RuntimeError("a child process ended early; its error is above") from None
