"""The ports of a controller, which are the same on every one."""

import socket
from typing import Final

__all__ = ["PORTS", "listeners"]

PORTS: Final = {"rtde": 30004, "dashboard": 29999, "script": 30003}


def listeners(host: str) -> dict[str, socket.socket]:
    """A socket that listens on each; raises OSError when one is taken."""
    made: dict[str, socket.socket] = {}
    try:
        for name, number in PORTS.items():
            made[name] = socket.socket()
            made[name].setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            made[name].bind((host, number))
            made[name].listen()
            made[name].setblocking(False)
    except OSError:
        for listener in made.values():
            listener.close()
        raise
    return made
