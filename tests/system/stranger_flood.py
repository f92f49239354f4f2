"""A crowd without certificates: it connects to ports so often, and keeps connections on which it says nothing.

    stranger_flood.py TARGETS PER_S IDLE ADDRESSES USER

TARGETS are HOST:PORT with commas; ADDRESSES those that it comes from, with commas, or ``-``; USER the number of a user
to be, or ``-``. Says ``{"answer": ...}`` with
what it has done once the idle ones are there, and again when its input ends.
"""

import errno
import itertools
import json
import os
import select
import socket
import sys
import threading
import time

_LIVES_S = 0.2


def main(targets: str, per_s: str, idle: str, addresses: str, user: str) -> None:
    if user != "-":
        os.setgroups([])
        os.setuid(int(user))
    ends = [(host, int(port)) for host, _, port in (target.rpartition(":") for target in targets.split(","))]
    origins = itertools.cycle([None] if addresses == "-" else addresses.split(","))
    ending, done = threading.Event(), [0]
    kept = [dialled(end, next(origins)) for _ in range(int(idle) // len(ends)) for end in ends]
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline and not all(connected(sock) for sock in kept):
        time.sleep(0.05)
    say({"idle": sum(connected(sock) for sock in kept)})
    thread = threading.Thread(target=connect, args=(ends, float(per_s), origins, ending, done))
    thread.start()
    began = time.monotonic()
    sys.stdin.read()
    ending.set()
    thread.join()
    say({"per_s": done[0] / (time.monotonic() - began)})


def dialled(end: tuple[str, int], origin: str | None) -> socket.socket:
    sock = socket.socket()
    sock.setblocking(False)
    if origin is not None:
        sock.bind((origin, 0))
    failed = sock.connect_ex(end)
    assert failed in (0, errno.EINPROGRESS, errno.EAGAIN), errno.errorcode[failed]
    return sock


def connected(sock: socket.socket) -> bool:
    return bool(select.select([], [sock], [], 0)[1])


def connect(ends, per_s, origins, ending, done) -> None:  # type: ignore[no-untyped-def]
    there: list[tuple[float, socket.socket]] = []
    began = time.monotonic()
    while not ending.is_set():
        now = time.monotonic()
        for _ in range(min(200, int((now - began) * per_s) - done[0])):
            there.append((now, dialled(ends[done[0] % len(ends)], next(origins))))
            done[0] += 1
        while there and there[0][0] < now - _LIVES_S:
            there.pop(0)[1].close()
        ending.wait(0.005)
    for _, sock in there:
        sock.close()


def say(answer: object) -> None:
    print(json.dumps({"answer": answer}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
