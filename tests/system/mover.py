"""A client that sets the pan joint moving and stays; says when it has begun.

``mover.py call|start|leave|forked|jog|relay|plan``. ``leave`` exits at SIGTERM, with its started move under way.
"""

import os
import signal
import sys
import time

import trade
from trade import service, where

FAR_RAD, SPEED_RAD_S = 1.3, 0.1


def handle(name: str) -> trade.Handle:
    return trade.find(where(name=name, group="rosie.neck.pan"), wait_s=30).with_(deadline_s=120)


class Relay:
    """Moves the joint on behalf of its caller."""

    @service(effect="actuate")
    def go(self) -> float:
        return handle("move_to")(FAR_RAD, SPEED_RAD_S)


def main(how: str) -> None:
    match how:
        case "call":
            move = handle("move_to")
            say()
            move(FAR_RAD, SPEED_RAD_S)
        case "start":
            run = handle("move_to").start(FAR_RAD, SPEED_RAD_S)
            say()
            run.result()
        case "leave":
            handle("move_to").start(FAR_RAD, SPEED_RAD_S)
            signal.signal(signal.SIGTERM, lambda *_: sys.exit())
            say()
            time.sleep(120)
        case "forked":
            move = handle("move_to")
            if os.fork() == 0:
                time.sleep(120)  # it keeps the sockets of the transport open
            say()
            move(FAR_RAD, SPEED_RAD_S)
        case "jog":
            turn = handle("set_velocity")
            say()
            while True:
                turn(SPEED_RAD_S, 0.5)
                time.sleep(0.05)
        case "relay":
            trade.register(Relay(), "relay")
            say()
            time.sleep(120)
        case "plan":
            go = trade.find(where(name="go", group="relay"), wait_s=30).with_(deadline_s=120)
            say()
            go()


def say() -> None:
    print("{}", flush=True)


main(sys.argv[1])
