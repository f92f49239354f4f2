"""A zenoh router as ROS 2 runs one (``rmw_zenohd``), as a process: ``python -m tests.support.ros2_router PORT``.

Ends when its standard input does. Of the configuration of ROS 2 it has what matters to others: it does not pass on what
peers say to each other.
"""

import json
import sys

import zenoh


def main() -> None:
    config = zenoh.Config()
    settings = {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{sys.argv[1]}"],
        "scouting/multicast/enabled": False,
        "routing/router/peers_failover_brokering": False,
        "timestamping/enabled": True,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
