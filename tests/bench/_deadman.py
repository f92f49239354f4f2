"""How long a joint still moves after the program that moves it was killed or frozen; the simulator's log is the judge.

A client process moves a simulated joint through a driver in a process of its own. Measured is from the signal to the
joint's rest: noticing, stopping and braking together.
"""

import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from statistics import quantiles

import trade
from tests.bench._report import keep_point, print_target
from trade_hil_sim import SimProcess, events

_ROOT = Path(__file__).parents[2]
_HEAD = _ROOT / "examples" / "head.toml"
_MOVER = _ROOT / "tests" / "system" / "mover.py"
_PATIENCE_S = 30.0
_HOME_RAD = -1.2
"""Far enough from where the client goes that it never gets there."""
_SIGNALS = {"killed": (signal.SIGKILL, 0.5), "frozen": (signal.SIGSTOP, 2.0)}
_WAYS = {"killed": ("call", "start"), "frozen": ("call", "jog")}


def run(rounds: int) -> None:
    """Measure and print; each round starts a robot and four clients."""
    os.environ["TRADE_SYSTEM"] = f"bench-{secrets.token_hex(4)}"
    results: dict[tuple[str, str], list[float]] = {}
    for i in range(rounds):
        with ExitStack() as stack:
            sim = _robot(stack)
            home = trade.find(trade.where(name="move_to", group="rosie.neck.pan"), wait_s=_PATIENCE_S)
            for end, ways in _WAYS.items():
                for how in ways:
                    home(_HOME_RAD)
                    results.setdefault((end, how), []).append(_stopped_after_s(sim, how, _SIGNALS[end][0]))
        print(f"deadman: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    print(f"deadman: seconds from the client's end to the joint's rest, {rounds} rounds; 95th percentile of each")
    for (end, how), seconds in results.items():
        most = _SIGNALS[end][1]
        keep_point("end of a client to rest", f"{end} in a {how}", rounds, {"s": seconds})
        p95 = quantiles(seconds, n=20, method="inclusive")[-1] if len(seconds) > 1 else seconds[0]
        print_target(
            f"{end} in a {how}", [min(seconds), p95, max(seconds)], f"at most {most}", lambda x, m=most: x <= m
        )


def _robot(stack: ExitStack) -> SimProcess:
    """Simulated servos and their driver, each in a process of its own."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    sim = stack.enter_context(SimProcess(_HEAD))
    robot_file = folder / "rosie.toml"
    lines = _HEAD.read_text().splitlines()
    robot_file.write_text(
        "\n".join(f'port = "{sim.ports["neck"]}"' if line.startswith("port =") else line for line in lines)
    )
    _started(stack, "-m", "trade_gateway", "up", str(robot_file), "--json")
    stack.callback(trade.close)
    return sim


def _started(stack: ExitStack, *words: str) -> "subprocess.Popen[bytes]":
    process = stack.enter_context(subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE))
    stack.callback(process.kill)
    assert process.stdout is not None
    if not process.stdout.readline():
        raise RuntimeError(f"{' '.join(words)} did not begin; see above")
    return process


def _stopped_after_s(sim: SimProcess, how: str, number: int) -> float:
    with ExitStack() as stack:
        client = _started(stack, str(_MOVER), how)
        _wait(sim, moving=True)
        time.sleep(0.3)  # at its full speed
        ended = time.monotonic()
        client.send_signal(number)
        _wait(sim, moving=False)
        return max(0.0, events(sim.entries(), "at_rest", device_id=1)[-1].t - ended)


def _wait(sim: SimProcess, *, moving: bool) -> None:
    """Until the joint moves or rests; RuntimeError if it does not."""
    deadline = time.monotonic() + _PATIENCE_S
    while (sim.control.device(1).velocity_rad_s != 0) is not moving:
        if time.monotonic() > deadline:
            raise RuntimeError(f"it was to be {'moving' if moving else 'at rest'} within {_PATIENCE_S} s")
        time.sleep(0.02)
