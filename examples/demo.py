"""The main job, on simulated hardware: a head moves through remote service calls, and what is unsafe is refused.

Processes: the simulated servos, the driver container, the behaviours, of which two want the same head. What they say is
checked against the simulator's own log of what the servos did; the demo fails if they disagree.

    make demo                  the story, then everything ends
    make demo ARGS=--stay      and the robot stays up for you to play with
"""

import argparse
import contextlib
import json
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TypeVar

import trade
from trade import Settings, errors, where
from trade_hil_sim import SimControl, events, motion_writes, read_log

HERE = Path(__file__).parent
ROBOT = HERE / "rosie.toml"
LOOKS_RAD = (0.6, -0.6, 0.0)
AGREE_RAD = 0.02
"""The servo's own dead band is about a tenth of this."""
PATIENCE_S = 60.0

_T = TypeVar("_T")


class DemoFailed(Exception):
    """What was shown is not what should have been."""


@contextlib.contextmanager
def robot_up(log: Path) -> Generator[dict[str, str]]:
    """The driver container with simulated servos, in processes of their own; yields what it says when it is ready."""
    command = [sys.executable, "-m", "trade_gateway", "up", str(ROBOT), "--sim", "--sim-log", str(log), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as driver:
        try:
            assert driver.stdout is not None
            line = driver.stdout.readline()
            if not line:
                raise DemoFailed("the robot did not come up; see the message above")
            yield json.loads(line)
        finally:
            driver.terminate()
            try:
                driver.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                driver.kill()


def behave() -> None:
    """Run the behaviour in a process of its own and let it speak."""
    ended = subprocess.run([sys.executable, str(HERE / "look_around.py")], timeout=PATIENCE_S, check=False)
    if ended.returncode != 0:
        raise DemoFailed(f"the behaviour failed with exit code {ended.returncode}")


def compare_with_log(path: Path, began_s: float) -> None:
    """The judge: where the pan servo came to rest, and whether anything was sent for the refused command."""
    entries = [entry for entry in read_log(path) if entry.t >= began_s]
    rests = [entry for entry in events(entries, "at_rest") if entry.joint.endswith("neck.pan")]
    print("the simulator's log, of what the pan servo itself did:")
    for entry in rests:
        angle_rad, counts = entry.position_rad or 0.0, entry.position_counts
        print(f"  {entry.t - began_s:6.2f} s  at rest at {angle_rad:+.3f} rad ({counts} counts)")
    angles = [entry.position_rad or 0.0 for entry in rests]
    if len(angles) != len(LOOKS_RAD) or any(abs(a - b) > AGREE_RAD for a, b in zip(angles, LOOKS_RAD, strict=True)):
        raise DemoFailed(f"the servo should have come to rest at {LOOKS_RAD}, but was at {angles}")
    late = motion_writes(entries, since=rests[-1].t)
    print(f"  after that nothing that could move it was sent: {len(late)} motion writes for the refused command")
    if late:
        raise DemoFailed("the refused command reached the wire")


@contextlib.contextmanager
def behaviour(role: str) -> Generator["subprocess.Popen[str]"]:
    """One of the two that want the head, in a process of its own."""
    command = [sys.executable, str(HERE / "who_has_the_head.py"), role]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def hear(process: "subprocess.Popen[str]", until: str) -> None:
    """Repeat what a behaviour says, up to a line that it must say."""
    assert process.stdout is not None
    for line in process.stdout:
        print(f"  {line}", end="")
        if until in line:
            return
    raise DemoFailed(f"a behaviour ended without saying {until!r}")


def arbitrate(log: Path) -> None:
    """Two behaviours want the head; then the one that has it is killed."""
    print("\ntwo behaviours want the same head:")
    with behaviour("find-target") as finding:
        hear(finding, "I have the head")
        with behaviour("navigate") as navigating:
            hear(navigating, "has the head, for 'finding a target'")
            hear(finding, "I have let go")
            free_s = time.monotonic()
            hear(navigating, "I have the head")
            wait_for(lambda: events(read_log(log), "motion_started", device_id=1, since=free_s))  # not the sweep before
            killed_s = time.monotonic()
            navigating.kill()
            rests = wait_for(lambda: events(read_log(log), "at_rest", device_id=1, since=killed_s))
    print(f"  navigate was killed (kill -9); {rests[0].t - killed_s:.3f} s later the pan servo was at rest")
    with trade.lock(where(group="rosie.head"), purpose="a look at the end", wait_s=10):
        print(f"  {time.monotonic() - killed_s:.3f} s after the kill the demo itself has the head")


def wait_for(what: Callable[[], _T]) -> _T:
    """What the simulator's log shows, once it does."""
    until = time.monotonic() + PATIENCE_S
    while not (found := what()):
        if time.monotonic() > until:
            raise DemoFailed("the simulator's log does not show what should have happened")
        time.sleep(0.05)
    return found


def tell(log: Path, *, mute: bool, stay: bool) -> None:
    with robot_up(log) as ready:
        print(f"rosie is up: simulated servos, driver container {ready['container']!r}, system {ready['system']!r}\n")
        if mute:
            with SimControl(ready["control"]) as control:
                control.mute()
            print("the simulator was muted: the servos no longer answer\n")
        began_s = time.monotonic()
        behave()
        print()
        compare_with_log(log, began_s)
        arbitrate(log)
        look = trade.find(where(name="move_to", group="rosie.head"))
        if stay:
            wait_for_the_user(log)
            return
    print("\na handle kept by this process, after the driver has left:")
    expect_gone(look)
    with robot_up(log.with_suffix(".again")):
        again = trade.find(where(name="move_to", group="rosie.head"), wait_s=PATIENCE_S)
        print(f"  the robot is back; a new look-up finds it and it looks at {again([0.3, -0.2])[0]:+.3f} rad")


def wait_for_the_user(log: Path) -> None:
    with contextlib.suppress(KeyboardInterrupt):
        print("\nthe robot stays up; Ctrl-C here ends it\n")
        print("in another terminal:\n  source .venv/bin/activate\n  trade services --group rosie")
        print("  trade call rosie.head.move_to '[0.3, -0.2]'\n  trade call rosie.head.state")
        print(f"the log of all bytes: {log}\n")
        while True:
            time.sleep(1)


def expect_gone(look: trade.Handle) -> None:
    try:
        look([0.0, 0.0])
    except (errors.ServiceGone, errors.ContainerLost) as gone:
        print(f"  {type(gone).__name__}: {gone}")
    else:
        raise DemoFailed("a call through a stale handle went through")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stay", action="store_true", help="keep the robot up until Ctrl-C")
    parser.add_argument("--mute", action="store_true", help="mute the simulated servos: the demo must fail")
    options = parser.parse_args()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    if not options.stay:  # a system of its own, so that it disturbs nobody
        os.environ["TRADE_SYSTEM"] = f"demo-{secrets.token_hex(3)}"
    began_s = time.monotonic()
    try:
        trade.start(Settings.read(container="demo"))
        with tempfile.TemporaryDirectory(prefix="trade-demo-") as folder:
            tell(Path(folder) / "bytes.jsonl", mute=options.mute, stay=options.stay)
    except (DemoFailed, errors.TradeError, subprocess.TimeoutExpired) as failed:
        print(f"\nthe demo failed: {failed}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    finally:
        trade.close()
    print(f"\ndone in {time.monotonic() - began_s:.0f} s. Next: make demo ARGS=--stay, README.md, docs/guide.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
