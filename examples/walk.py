"""Rosie walks: one behaviour has both legs, another one the head at the same time, and a third wants the legs, too.

Run each in a process of its own, while rosie is up (`trade up examples/rosie.toml --sim`):

    python examples/walk.py walk      three steps
    python examples/walk.py watch     looks around under a lock of its own, until it is ended
    python examples/walk.py kick      wants a leg, and learns who has it
"""

import sys

import trade
from trade import Handle, Settings, errors, where

LEGS = where(group="rosie.legs")
BOTH = LEGS & where(kind="JointGroup")
HEAD = where(group="rosie.head")

STAND, FORWARD, BACK, LIFTED = [0.0, 0.2, 0.0], [0.3, 0.2, -0.1], [-0.3, 0.2, 0.1], [0.3, 0.8, 0.0]
"""Hip, knee and ankle of one leg, in rad."""
HALF_A_STEP_S = 0.75
STEPS = ("left", "right", "left")
WALKING = ("joints", "move_to", "follow", "enable", "state")
KICK_RAD = 1.5
"""Of the left knee; no step bends it that far."""


def service(name: str, of: trade.Constraint) -> Handle:
    return trade.find(of & where(name=name), wait_s=10).with_(deadline_s=30)


def both(leg: str, this: list[float], other: list[float]) -> list[float]:
    """The angles of both legs, left before right, from those of this leg and of the other one."""
    return this + other if leg == "left" else other + this


def walk() -> None:
    """Lock both legs, enable them, stand, take three steps, stand; the driver follows the points by itself."""
    joints, move_to, follow, enable, state = (service(name, BOTH) for name in WALKING)
    with trade.lock(LEGS, purpose="walk"):
        print("walk: I have both legs", flush=True)
        for leg in state():
            if leg.fault:
                print(f"walk: {leg.name} had a fault: {leg.fault}", flush=True)
        enable()
        reached = move_to(STAND + STAND, speed_rad_s=1.0)
        for leg in STEPS:
            through = (reached, both(leg, LIFTED, STAND), both(leg, FORWARD, BACK))
            points = [{"time_from_start_s": i * HALF_A_STEP_S, "positions_rad": at} for i, at in enumerate(through)]
            reached = follow({"joints": joints(), "points": points})
            print(f"walk: a step with the {leg} leg", flush=True)
        move_to(STAND + STAND, speed_rad_s=1.0)
        print("walk: I stand", flush=True)


def watch() -> None:
    """Look from side to side, under a lock of one's own."""
    look = service("move_to", HEAD)
    with trade.lock(HEAD, purpose="watch the way"):
        print("watch: I have the head", flush=True)
        while True:  # until this process is killed
            for pan_rad in (0.5, -0.5):
                look([pan_rad, -0.2])
                print(f"watch: looked to {pan_rad:+.1f} rad", flush=True)


def kick() -> None:
    """Ask for the legs, then try without: neither is granted, and the refusals say why."""
    knee = service("move_to", where(group="rosie.legs.left.knee"))
    try:
        with trade.lock(LEGS, purpose="kick a ball", wait_s=0):
            print("kick: the legs were free", flush=True)
    except errors.LockedByOther as taken:
        print(f"kick: {taken.owner} has the legs, for {taken.purpose!r}", flush=True)
    try:
        knee(KICK_RAD)
        print("kick: the knee moved", flush=True)
    except errors.LockedByOther as taken:
        print(f"kick: refused: {taken}", flush=True)


if __name__ == "__main__":
    trade.start(Settings.read(container=sys.argv[1]))
    try:
        {"walk": walk, "watch": watch, "kick": kick}[sys.argv[1]]()
    except errors.TradeError as failed:
        sys.exit(f"{sys.argv[1]}: {type(failed).__name__}: {failed}")
