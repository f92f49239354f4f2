"""A TCP connection in our own hands: ``slow_wire.py NAMESPACE NAME ADDRESS``, which listens there.

The first line of its input says as JSON where to ``connect``. Each further one says for how many seconds at most what
goes ``up`` to there and ``down`` from there is held back, again for whatever has come; it answers how often it has held
something back so far. Nothing overtakes anything, as on every TCP connection.
"""

import json
import random
import socket
import sys
import threading
import time
from contextlib import suppress

_MOST_BYTES = 1 << 16


def _place(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    return host, int(port)


class Wire:
    def __init__(self, connect: str) -> None:
        self._connect = _place(connect)
        self._most_s = {"up": 0.0, "down": 0.0}
        self._changed = threading.Condition()
        self.held = 0

    def slow(self, **most_s: float) -> None:
        with self._changed:
            self._most_s = most_s
            self._changed.notify_all()

    def serve(self, listening: socket.socket) -> None:
        while True:
            here, _ = listening.accept()
            threading.Thread(target=self._link, args=(here,), daemon=True).start()

    def _link(self, here: socket.socket) -> None:
        try:
            there = socket.create_connection(self._connect, timeout=5)
        except OSError:  # no server listens there now
            here.close()
            return
        there.settimeout(None)
        for one in (here, there):
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
        down = threading.Thread(target=self._carry, args=(there, here, "down"), daemon=True)
        down.start()
        self._carry(here, there, "up")
        down.join()
        here.close()
        there.close()

    def _carry(self, one: socket.socket, other: socket.socket, way: str) -> None:
        """Whatever comes on one side goes out on the other; both end when either does."""
        with suppress(OSError):
            while data := one.recv(_MOST_BYTES):
                self._hold(way)
                other.sendall(data)
        for each in (one, other):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def _hold(self, way: str) -> None:
        """For a random while, or until nothing is held back any more."""
        with self._changed:
            if self._most_s[way]:
                self.held += 1
                until = time.monotonic() + random.random() * self._most_s[way]
                self._changed.wait_for(lambda: not self._most_s[way], until - time.monotonic())


def main(address: str) -> None:
    wire = Wire(json.loads(sys.stdin.readline())["connect"])
    with socket.create_server(_place(address), backlog=64) as listening:
        threading.Thread(target=wire.serve, args=(listening,), daemon=True).start()
        print(json.dumps({"answer": "ready"}), flush=True)
        for line in sys.stdin:
            wire.slow(**json.loads(line))
            print(json.dumps({"answer": wire.held}), flush=True)


if __name__ == "__main__":
    main(sys.argv[3])
