"""A node of ROS 2 by our own hand, in a process of its own: it numbers itself as rmw_zenoh does, by its tokens.

    python -m tests.support.ros2_graph_node PORT NODE_NAME

Its commands and reports are those of `ros2_sdk_node`.
"""

import json
import sys
import threading
import time

from tests.support.ros2_output import tell
from trade_gateway.ros.ros2 import Ros2


class Node:
    def __init__(self, port: int, name: str) -> None:
        self._graph = Ros2(f"tcp/127.0.0.1:{port}", node=f"/{name}")

    def repeat(self, topic: str, value: float, hz: float) -> None:
        publisher = self._graph.advertise(topic, "std_msgs/msg/Float64")

        def say() -> None:
            while True:
                publisher.send({"data": value})
                time.sleep(1 / hz)

        threading.Thread(target=say, daemon=True).start()

    def set_bool(self, service: str, data: bool) -> None:
        tell("set", **self._graph.call(service, "std_srvs/srv/SetBool", {"data": data}, 30.0))


def main() -> None:
    node = Node(int(sys.argv[1]), sys.argv[2])
    tell("ready")
    for line in sys.stdin:
        asked = json.loads(line)
        getattr(node, asked.pop("do"))(**asked)


if __name__ == "__main__":
    main()
