"""Comes without a link while strangers are at the ports, stops a group on the stop line, and says if it was done.

Whether a device has confirmed it is another matter: it may be away.

rescuer.py GROUP LIMIT_S CONNECT...
"""

import json
import os
import sys

from trade import Settings
from trade.stop_line import StopLines


def main(group: str, limit_s: str, *connect: str) -> None:
    lines = StopLines(Settings.read(container="rescuer", connect=connect or None))
    call = lines.stop(group, "a rescue", float(limit_s))
    report = call.wait()
    print(
        json.dumps({"through": bool(report.stopped or report.failed), "said": f"{report} {call.problems}"}), flush=True
    )
    os._exit(0)  # after its answer it waits for no other thread


if __name__ == "__main__":
    main(*sys.argv[1:])
