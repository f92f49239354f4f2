"""Two behaviours that want the same head: one finds a target with it, the other needs it to navigate.

Run each in a process of its own, while rosie is up (`trade up examples/rosie.toml --sim`):

    python examples/who_has_the_head.py find-target
    python examples/who_has_the_head.py navigate
"""

import sys
import threading

import trade
from trade import Handle, Settings, errors, where

HEAD = where(group="rosie.head")
SLOWLY_RAD_S = 0.3


def service(name: str) -> Handle:
    return trade.find(HEAD & where(name=name), wait_s=10)


def find_target() -> None:
    """Sweep the head from side to side until another client requests it."""
    asked, stopped = threading.Event(), threading.Event()
    sweep, stop = service("move_to"), service("stop")

    def give_way(who: str, why: str) -> None:
        print(f"find-target: {who} asks for the head: {why}; I stop and let go", flush=True)
        asked.set()
        stop()  # a stop by the owner needs no resume
        stopped.set()

    with trade.lock(HEAD, purpose="finding a target", on_request=give_way):
        print("find-target: I have the head", flush=True)
        while not asked.is_set():
            try:
                sweep.with_(deadline_s=30)([1.2, 0.0], speed_rad_s=SLOWLY_RAD_S)
                sweep.with_(deadline_s=30)([-1.2, 0.0], speed_rad_s=SLOWLY_RAD_S)
            except errors.MotionStopped:
                break
        stopped.wait(10)
    print("find-target: I have let go", flush=True)


def navigate() -> None:
    """Look ahead; ask the current owner of the head to release it."""
    look = service("move_to")  # waits for the head, which a lock with wait_s=0 does not
    try:
        with trade.lock(HEAD, wait_s=0):
            print("navigate: the head was free", flush=True)
    except errors.LockedByOther as taken:
        print(f"navigate: {taken.owner} has the head, for {taken.purpose!r}", flush=True)
        trade.request_release(HEAD, "there is something ahead of me")
    with trade.lock(HEAD, purpose="navigation", wait_s=10):
        print("navigate: I have the head", flush=True)
        while True:  # until this process is killed
            for pan_rad in (1.3, -1.3):
                look.with_(deadline_s=30)([pan_rad, 0.0], speed_rad_s=SLOWLY_RAD_S)


if __name__ == "__main__":
    trade.start(Settings.read(container=sys.argv[1]))
    {"find-target": find_target, "navigate": navigate}[sys.argv[1]]()
