"""What an idle gateway costs: a simulated robot on one side, a client that knows it on the other."""

import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

import psutil

from tests.bench._children import child, hear
from tests.bench._report import keep_point, print_target
from tests.bench._site import ADDRESSES, SECURE, SYSTEM, Site

_ROSIE: Final = Path(__file__).parents[2] / "examples" / "rosie.toml"
_MOST_MIB, _MOST_CORE = 80.0, 2.0
_SETTLE_S: Final = 3.0


def run(site: Site, door: int, seconds: float) -> None:
    """Measure and print.

    Args:
        site: where the door is up, with certificates.
        door: its process id.
        seconds: how long it is looked at.
    """
    robot = site.begin(
        "robot",
        "-m",
        "trade_gateway",
        "up",
        str(_ROSIE),
        "--sim",
        *(word for part in ("left_arm", "right_arm", "tail") for word in ("--without", part)),
        "--json",
        runtime="rosie",
        TRADE_SYSTEM=SYSTEM[SECURE],
        TRADE_TLS=str(site.papers("robot")),
        TRADE_POLICY=str(site.policy),
        TRADE_LISTEN="tls/127.0.0.1:0",
        TRADE_CONNECT=f"tls/{ADDRESSES['near']['door']}:{SECURE}",
    )
    process = psutil.Process(door)
    with child(_look, site.papers("planner"), site.policy, inside=site.host("office")) as planner:
        known = hear(planner)
        time.sleep(min(_SETTLE_S, seconds))
        print(f"idle gateway: {seconds:.0f} s", file=sys.stderr, flush=True)
        core, wakes, mib = _load(process, seconds)
    site.end(robot)
    print(f"\nidle gateway, {known} services known across it, over {seconds:.0f} s:")
    print(f"{process.num_threads()} threads, of which one wakes {wakes:.0f} times a second")
    keep_point("idle gateway", f"{known} services known", 1, {"MiB": [mib], "% of a core": [core], "wakes/s": [wakes]})
    print_target("idle gateway: RSS, MiB", [mib], f"at most {_MOST_MIB:.0f}", lambda mib: mib <= _MOST_MIB)
    print_target("idle gateway: % of a core", [core], f"at most {_MOST_CORE:.0f}", lambda share: share <= _MOST_CORE)


def _load(process: psutil.Process, seconds: float) -> tuple[float, float, float]:
    """Percent of a core, wakes a second and MiB."""
    before, began = process.cpu_times(), time.monotonic()
    switched = _switches(process.pid)
    time.sleep(seconds)
    after, took_s = process.cpu_times(), time.monotonic() - began
    spent_s = after.user + after.system - before.user - before.system
    return (
        100 * max(0.0, spent_s) / took_s,
        (_switches(process.pid) - switched) / took_s,
        process.memory_info().rss / 1024**2,
    )


def _switches(pid: int) -> int:
    """How often its threads have gone to sleep."""
    lines = (
        line
        for task in Path(f"/proc/{pid}/task").iterdir()
        for line in (task / "status").read_text().splitlines()
        if line.startswith("voluntary_ctxt_switches")
    )
    return sum(int(line.split()[1]) for line in lines)


def _look(pipe: Connection, papers: Path, policy: Path) -> None:
    from trade import Container, Settings, where

    door = f"tls/{ADDRESSES['far']['door']}:{SECURE}"
    settings = Settings.read(
        system=SYSTEM[SECURE],
        container="planner",
        listen=["tls/127.0.0.1:0"],
        connect=[door],
        tls=papers,
        policy=policy,
    )
    with Container(settings) as container:
        container.find(where(name="move_to", group="rosie.neck.pan"), wait_s=20)
        pipe.send(len(container.services(where(group="rosie"))))
        pipe.poll(None)
