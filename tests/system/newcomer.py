"""Comes into a system that others besiege: stops a group, gives an e-stop, and says how each went and how long it took.

newcomer.py GROUP LIMIT_S CONNECT...
"""

import json
import os
import sys
import time

from trade import Container, Settings
from trade.stop_line import StopLines


def main(group: str, limit_s: str, *connect: str) -> None:
    settings = Settings.read(container="newcomer", connect=connect or None)
    said: dict[str, object] = {}
    for what in ("line", "stop", "estop"):
        began = time.monotonic()
        if what == "line":
            report = StopLines(settings).stop(group, "a test", float(limit_s)).wait()
        else:
            with Container(settings) as container:
                opened = time.monotonic()
                if what == "stop":
                    report = container.stop(group, "a test", limit_s=float(limit_s))
                else:
                    report = container.estop("a test", limit_s=float(limit_s))
                said[f"opened_{what}"] = round(opened - began, 3)
                said[what] = [report.complete, round(time.monotonic() - began, 3), str(report)]
            continue
        said[what] = [report.complete, round(time.monotonic() - began, 3), str(report)]
    print(json.dumps(said), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
