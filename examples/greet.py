"""Rosie greets: both arms and the tail move at the same time, under one lock over three wires.

Run it while she is up (`trade up examples/rosie.toml --sim`; `--without left_arm` where ur-rtde cannot be installed):

    python examples/greet.py
"""

import sys

import trade
from trade import Handle, errors, where

LEFT, RIGHT, TAIL = where(group="rosie.left.arm"), where(group="rosie.right.arm"), where(group="rosie.tail")
LOWERED, RAISED = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.5, -0.8, 0.6, 0.3, 0.0, 0.5]
WAGS = [0.4, 0.3], [-0.4, -0.3], [0.0, 0.0]
"""Of the root of the tail and its tip, in rad."""


def service(name: str, of: trade.Constraint) -> Handle:
    return trade.find(of & where(name=name), wait_s=10).with_(deadline_s=30)


def joints(name: str, of: trade.Constraint) -> Handle:
    return service(name, of & where(kind="JointGroup"))


def has_left_arm() -> bool:
    """Asked once the rest of the robot is known."""
    for part in (RIGHT, TAIL):
        joints("move_to", part)
    try:
        return bool(trade.find(LEFT & where(name="move_to_pose"), wait_s=1))
    except errors.NoSuchService:
        return False


def greet() -> None:
    has_left = has_left_arm()
    with trade.lock(LEFT | RIGHT | TAIL, purpose="greet"):
        print("one lock over " + ("both arms and the tail" if has_left else "the right arm and the tail"), flush=True)
        for part in (RIGHT, TAIL):
            joints("enable", part)()
        if has_left:
            service("power_on", LEFT)()  # of an arm, power and brakes are switched by nothing but these
            service("release_brakes", LEFT)()
            service("move_to_pose", LEFT)("home")
        waving = service("move_to_pose", LEFT).start("wave") if has_left else None
        raising = joints("move_to", RIGHT).start(RAISED)
        for wag in WAGS:
            joints("move_to", TAIL)(wag)
        shoulder = raising.result()[1]
        print(f"the tail has wagged, the right arm is raised: its shoulder at {shoulder:+.2f} rad", flush=True)
        if waving is not None:
            print(f"the left arm waves: its base at {waving.result()[0]:+.2f} rad", flush=True)
            service("move_to_pose", LEFT)("home")
        joints("move_to", RIGHT)(LOWERED)


if __name__ == "__main__":
    try:
        greet()
    except errors.TradeError as failed:
        sys.exit(f"{type(failed).__name__}: {failed}")
