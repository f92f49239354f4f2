"""A behaviour: find a robot's head by what it is, look left and right, see a limit refused.

Nothing here knows where the head is, which motors it has or who made them. Run it while a robot is up:

    trade up examples/rosie.toml --sim          (one terminal)
    python examples/look_around.py              (another)
"""

import sys

import trade
from trade import errors, where


def look_around() -> None:
    look = trade.find(where(name="move_to", group="rosie.head"))
    print(f"found {look.label} in container {look.container} on {look.host}")
    print(f"  {look.signature}")

    for direction, pan_rad in (("left", 0.6), ("right", -0.6), ("ahead", 0.0)):
        pan, tilt = look([pan_rad, 0.1])
        print(f"looked {direction}: pan {pan:+.3f} rad, tilt {tilt:+.3f} rad")

    try:
        look([3.0, 0.0])
    except errors.LimitExceeded as refused:
        print(f"refused: {refused}")


if __name__ == "__main__":
    try:
        look_around()
    except errors.TradeError as failed:
        sys.exit(f"{type(failed).__name__}: {failed}")
