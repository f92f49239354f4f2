"""Holds a lock, moves a joint repeatedly and receives notifications and samples; prints a line a round."""

import itertools
import json
import threading
import time
from datetime import datetime, timezone

from trade import Container, Settings, where

LEASE_S = 10.0
PAN = "rosie.neck.pan"

with Container(Settings.read(container="holder")) as holder:
    move = holder.find(where(name="move_to", group=PAN), wait_s=30).with_(deadline_s=60)
    ticks, samples = itertools.count(1), itertools.count(1)
    seen = {"ticks": 0, "samples": 0}
    after = threading.Event()
    holder.every(0.02, lambda: seen.update(ticks=next(ticks)))
    state = holder.find(where(name="state", group=PAN), wait_s=30)
    holder.stream(state, hz=50, call=lambda _: seen.update(samples=next(samples)))
    lost: list[str] = []
    lock = holder.lock(where(group=PAN), purpose="hold", lease_s=LEASE_S, on_lost=lambda why: lost.append(str(why)))
    with lock:
        while True:
            after.clear()
            holder.after(0.05, after.set)
            for goal_rad in (0.1, -0.1):
                move(goal_rad)
            reported = {"after": after.wait(60), "held": lock.held, "lost": lost, **seen}
            year = datetime.now(timezone.utc).year
            print(json.dumps({"wall_s": time.time(), "year": year, **reported}), flush=True)
