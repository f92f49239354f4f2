"""A behaviour: activate a gripper, close it, and report whether it holds an object.

Run it while a robot with a hand is up (`trade up examples/rosie.toml --sim`):

    python examples/grip.py
"""

import sys

import trade
from trade import errors, where

HAND = where(group="rosie.left.hand")


def grip() -> None:
    activate, open_, close = (trade.find(HAND & where(name=name)) for name in ("activate", "open", "close"))
    with trade.lock(HAND, purpose="grip"):
        activate.with_(deadline_s=30)()  # the fingers go all the way, so it is never done by itself
        print("activated: the fingers have found their stops")
        open_()
        state = close(force_n=40)
        found = "holding" if state.holding else "nothing there"
        print(f"{found}: the fingers stand {state.width_m * 1e3:.0f} mm apart")


if __name__ == "__main__":
    try:
        grip()
    except errors.TradeError as failed:
        sys.exit(f"{type(failed).__name__}: {failed}")
