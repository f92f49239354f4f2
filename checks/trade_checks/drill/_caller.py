"""The caller of a drill, as a process that can be killed: it moves what its orders say, and stays.

``_caller ORDERS`` (JSON, a list of `Order`) prints ``{"ready": true}`` once everything is enabled. It begins at the
first line of standard input, stops sending but lives on at the second, and ends with it. It prints
``{"error": ...}`` for a failure.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import msgspec

import trade
from trade import Handle, where
from trade.errors import DeviceError, TradeError

_FOUND_S: Final = 30.0
_ENABLED_S: Final = 30.0
"""How long devices may take to become enabled, in seconds: after a bus was lost, they return one by one."""
_PAUSE_S: Final = 0.25
_MOVE_S: Final = 120.0
_PERIOD_S: Final = 0.05
"""Time between two set-points, in seconds."""


class Order(msgspec.Struct, frozen=True, kw_only=True):
    """A request to move one group of joints."""

    group: str
    arm: bool
    stream: bool
    """Whether to stream set-points instead of a single move; an arm gets a distant one, at full speed."""
    from_rad: list[float]
    """The start position: one angle, or the angles of an arm's joints."""
    goal_rad: list[float]
    speed_rad_s: float
    valid_s: float
    """Validity of a set-point in seconds."""


def main() -> None:
    """Runs the caller."""
    orders = msgspec.json.decode(sys.argv[1], type=list[Order])
    hushed = threading.Event()
    try:
        with ThreadPoolExecutor(len(orders)) as threads:
            list(threads.map(_enable, [order.group for order in orders]))
            begin = list(threads.map(_beginning, orders))
            _say({"ready": True})
            sys.stdin.readline()
            for each in begin:
                threads.submit(_moved, each, hushed)
            sys.stdin.readline()
            hushed.set()
            while sys.stdin.readline():
                pass
            trade.close()  # its motion ends with it
    except TradeError as problem:
        _say({"error": f"{type(problem).__name__}: {problem}"})
        sys.exit(1)


def _beginning(order: Order) -> Callable[[threading.Event], None]:
    """Returns the function that executes an order."""
    if not order.stream:
        move = _service(order.group, "move_joints" if order.arm else "move_to").with_(deadline_s=_MOVE_S)
        goal = order.goal_rad if order.arm else order.goal_rad[0]
        return lambda _: move(goal, order.speed_rad_s)
    turn = _service(order.group, "servo" if order.arm else "set_velocity")
    forwards = order.goal_rad[0] > order.from_rad[0]
    point = order.goal_rad if order.arm else order.speed_rad_s if forwards else -order.speed_rad_s

    def stream(hushed: threading.Event) -> None:
        while not hushed.wait(_PERIOD_S):
            turn(point, order.valid_s)

    return stream


def _moved(motion: Callable[[threading.Event], None], hushed: threading.Event) -> None:
    try:
        motion(hushed)
    except TradeError as problem:
        _say({"error": f"{type(problem).__name__}: {problem}"})


def _enable(group: str) -> None:
    """Enables a device as soon as it allows that."""
    until, pause, steps = time.monotonic() + _ENABLED_S, threading.Event(), _steps(group)
    while not _done(steps, give_up=time.monotonic() > until):
        pause.wait(_PAUSE_S)


def _done(steps: Callable[[], Sequence[Handle]], *, give_up: bool) -> bool:
    try:
        for step in steps():
            step()
    except DeviceError:
        if give_up:
            raise
        return False
    return True


def _steps(group: str) -> Callable[[], Sequence[Handle]]:
    """Returns a function for the services to call before it can move, by its current state."""
    state = _service(group, "state")
    names = {handle.name: handle for handle in trade.services(where(group=group)) if group in handle.groups}
    if "enable" in names:
        return lambda: [names["enable"]]

    def of_an_arm() -> list[Handle]:
        now: Any = state()
        wanted = {
            "unlock_protective_stop": now.safety == "protective stop",
            "power_on": not now.powered,
            "release_brakes": not now.enabled,
        }
        return [names[name] for name, needed in wanted.items() if needed]

    return of_an_arm


def _service(group: str, name: str) -> Handle:
    """The service of exactly that group, not of one beneath it."""
    until, pause = time.monotonic() + _FOUND_S, threading.Event()
    while True:
        for handle in trade.services(where(name=name, group=group)):
            if group in handle.groups:
                return handle
        if time.monotonic() > until:
            return trade.find(where(name=name, group=group))  # its error lists what exists
        pause.wait(_PAUSE_S)


def _say(what: dict[str, object]) -> None:
    line = json.dumps(what) + "\n"
    os.write(sys.stdout.fileno(), line.encode())  # atomic, also with several threads


if __name__ == "__main__":
    main()
