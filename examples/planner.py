"""A planner that lacks an ability: no service that it knows can see a mug, so it searches for one that can.

Run each in a process of its own. The camera connects to no other container, so the others do not know it:

    python examples/planner.py arm
    TRADE_LISTEN=tcp/127.0.0.1:7461 TRADE_CONNECT=tcp/127.0.0.1:7461 python examples/planner.py camera
    python examples/planner.py planner
"""

import queue
import sys
import threading

from msgspec import Struct

import trade
from trade import Handle, Settings, errors, service, where

WAIT_S = 60.0


class Place(Struct, frozen=True):
    x_m: float
    y_m: float


class Camera:
    """A stand-in for a camera with object recognition."""

    @service(effect="read", achieves=["see(?object)"])
    def check_for(self, object_type: str) -> Place:
        """Where the nearest thing of that type is."""
        return {"mug": Place(0.4, -0.1), "plate": Place(0.5, 0.2)}[object_type]


class Arm:
    """A stand-in for an arm."""

    @service(achieves=["holding(?object)"])
    def pick_up(self, place: Place) -> None:
        print(f"arm: picking up at {place.x_m:+.1f} m, {place.y_m:+.1f} m", flush=True)


def offer(provider: object, group: str) -> None:
    """Register the provider until this process ends, and let others find it."""
    handles = trade.register(provider, group)
    trade.system.set_broadcast(True)
    print(f"{sys.argv[1]}: {', '.join(handle.label for handle in handles)}", flush=True)
    threading.Event().wait()


def able_to(goal: str) -> Handle:
    """A service of rosie that achieves the goal; searches unlinked containers if none is known."""
    able = where(achieves=goal, group="rosie")
    known = trade.services(able)
    if known:
        return known[0]
    print(f"planner: no service of rosie achieves {goal}; searching", flush=True)
    came: queue.SimpleQueue[Handle] = queue.SimpleQueue()
    waiting = trade.joined(able, came.put, existing=True)
    trade.system.set_discovery(True)
    try:
        return came.get(timeout=WAIT_S)
    except queue.Empty:
        sys.exit(f"planner: found no service within {WAIT_S:.0f} s that achieves {goal}")
    finally:
        trade.system.set_discovery(False)
        waiting.cancel()


def plan(thing: str) -> None:
    pick_up = trade.find(where(achieves=f"holding({thing})", group="rosie"), wait_s=WAIT_S)
    print(f"planner: {pick_up.label} achieves holding({thing}), and needs see({thing})", flush=True)
    look = able_to(f"see({thing})")
    print(f"planner: {look.label} has joined in container {look.container}", flush=True)
    place = look(thing)
    print(f"planner: the {thing} is at {place.x_m:+.1f} m, {place.y_m:+.1f} m", flush=True)
    pick_up(place)
    print(f"planner: holding({thing})", flush=True)


if __name__ == "__main__":
    trade.start(Settings.read(container=sys.argv[1]))
    try:
        match sys.argv[1]:
            case "camera":
                offer(Camera(), "rosie.eyes")
            case "arm":
                offer(Arm(), "rosie.arm")
            case _:
                plan("mug")
    except errors.TradeError as failed:
        sys.exit(f"{type(failed).__name__}: {failed}")
