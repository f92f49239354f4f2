"""What ten children cost a gateway, how soon one that crashed serves again, and what a start costs."""

import json
import os
import re
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import psutil

from tests.bench._report import keep_point, print_target
from trade import Container, Settings, where
from trade_hil_sim import SimProcess

_HEAD: Final = Path(__file__).parents[2] / "examples" / "head.toml"
_CHILDREN: Final = 10
_MOST_CORE, _MOST_S, _MOST_RATIO = 1.0, 1.5, 1.2
_MOST_START_S, _MOST_MIB = 0.6, 60.0
_PATIENCE_S: Final = 60.0
_LOOKS_S: Final = 0.002
"""Between two looks of who waits: without a rest, it takes one of two cores from what is measured."""


def run(rounds: int, seconds: float) -> None:
    """Measure and print.

    Args:
        rounds: how often a driver is killed, and started without a supervisor.
        seconds: how long the gateway of ten children is looked at.
    """
    with tempfile.TemporaryDirectory() as folder:
        places = {"TRADE_RUNTIME_DIR": f"{folder}/runtime", "TRADE_STATE_DIR": f"{folder}/state"}
        environment = {**os.environ, **places, "TRADE_SYSTEM": f"bench-{secrets.token_hex(4)}"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        environment["PYTHONPYCACHEPREFIX"] = f"{folder}/bytecode"  # compiled once, as an installation is
        os.environ.update(places)
        system, file = environment["TRADE_SYSTEM"], Path(folder) / "gateway.toml"
        with Container(Settings.read(system=system, container="bench")) as member:
            shares = _overhead(file, system, environment, member, seconds)
            again, plain = _restarts(file, system, environment, member, rounds)
        started, empty, mib = _starts(Path(folder) / "head.toml", environment, rounds)
    print(f"\nsupervisor, {_CHILDREN} children over {seconds:.0f} s; {rounds} crashes of a simulated head:")
    keep_point("a crash", "until it serves again", rounds, {"s": again})
    keep_point("a crash", "a plain start", rounds, {"s": plain})
    keep_point("one bus", "from start to service", rounds, {"s": started, "MiB": mib})
    keep_point("one bus", "python -c pass", rounds, {"s": empty})
    keep_point("idle", f"{_CHILDREN} children", 1, {"% of a core": shares})
    print_target("supervisor: % of a core", shares, f"at most {_MOST_CORE:g}", lambda share: share <= _MOST_CORE)
    print_target("crash to serving, s", again, f"at most {_MOST_S:g}", lambda took_s: took_s <= _MOST_S)
    ratios = [one / other for one, other in zip(again, plain, strict=True)]
    print_target("crash to serving / plain start", ratios, f"at most {_MOST_RATIO:g}", lambda one: one <= _MOST_RATIO)
    print_target("one bus: to service, s", started, f"at most {_MOST_START_S:g}", lambda one: one <= _MOST_START_S)
    print_target("one bus: RSS, MiB", mib, f"at most {_MOST_MIB:g}", lambda one: one <= _MOST_MIB)


def _overhead(file: Path, system: str, environment: dict[str, str], member: Container, seconds: float) -> list[float]:
    """Percent of a core that a gateway takes for ten children, beyond what one takes that only knows of them."""
    tables = "".join(f"[container.c{n}]\nproviders = []\n" for n in range(_CHILDREN))
    file.write_text(f'system = "{system}"\n{tables}')
    with (
        _trade(environment, "gateway", str(file)) as door,
        _trade(environment, "container", "--name", "idler") as idler,
    ):
        _until(lambda: _states(member).count("up") == _CHILDREN)
        print(f"supervisor: {seconds:.0f} s", file=sys.stderr, flush=True)
        processes = [psutil.Process(door.pid), psutil.Process(idler.pid)]
        before = [_spent_s(one) for one in processes]
        began = time.monotonic()
        time.sleep(seconds)
        gateway, idle = (_spent_s(one) - was for one, was in zip(processes, before, strict=True))
        return [100 * (gateway - idle) / (time.monotonic() - began)]


def _restarts(
    file: Path, system: str, environment: dict[str, str], member: Container, rounds: int
) -> tuple[list[float], list[float]]:
    """Seconds from the crash of a driver until the next one answers, and from the start of one by hand."""
    file.write_text(f'system = "{system}"\n[container.head]\nrobot = "{_HEAD}"\nsim = true\nrestarts = 1000\n')
    again: list[float] = []
    plain: list[float] = []
    for number in range(rounds):
        print(f"supervisor: crash {number + 1} of {rounds}", file=sys.stderr, flush=True)
        with _trade(environment, "gateway", str(file)):
            epoch = _served(member, "")
            [info] = member.call(where(name="children"))
            began = time.monotonic()
            os.kill(info.pid, signal.SIGKILL)
            _served(member, epoch)
            again.append(time.monotonic() - began)
        began = time.monotonic()
        with _trade(environment, "up", str(_HEAD), "--sim", "--name", "head", ready=False):
            _served(member, epoch)
            plain.append(time.monotonic() - began)
    return again, plain


def _starts(file: Path, environment: dict[str, str], rounds: int) -> tuple[list[float], list[float], list[float]]:
    """Of a driver with one bus: seconds until it says that it serves, those of an empty program, and its MiB."""
    started: list[float] = []
    empty: list[float] = []
    mib: list[float] = []
    with SimProcess(_HEAD) as sim:
        file.write_text(re.sub(r"(?m)^port = .*", f'port = "{sim.ports["neck"]}"', _HEAD.read_text()))
        for number in range(rounds + 1):
            began = time.monotonic()
            subprocess.run([sys.executable, "-c", "pass"], env=environment, check=True)
            empty.append(time.monotonic() - began)
            began = time.monotonic()
            with _trade(environment, "up", str(file)) as driver:
                started.append(time.monotonic() - began)
                mib.append(psutil.Process(driver.pid).memory_info().rss / 1024**2)
            print(f"supervisor: start {number} of {rounds}", file=sys.stderr, flush=True)
    return started[1:], empty[1:], mib[1:]  # the first one may compile


def _served(member: Container, not_by: str) -> str:
    """Wait until a head answers, of another epoch; returns its epoch."""
    found: list[str] = []

    def answers() -> bool:
        for state in member.services(where(name="state", group="rosie.head", kind="JointGroup")):
            if state.key.address.epoch != not_by:
                state()
                found.append(state.key.address.epoch)
        return bool(found)

    _until(answers)
    return found[0]


def _states(member: Container) -> list[str]:
    return [info.state for handle in member.services(where(name="children")) for info in handle()]


def _spent_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def _until(true: Callable[[], Any]) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while not true():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not so within {_PATIENCE_S:g} s")
        time.sleep(_LOOKS_S)
        time.sleep(0.01)


@contextmanager
def _trade(environment: dict[str, str], *words: str, ready: bool = True) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "trade_gateway", *words, "--json"]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        if ready:
            json.loads(process.stdout.readline())
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=_PATIENCE_S)
