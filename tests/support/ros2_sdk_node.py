"""A node of ROS 2 by another hand: the package zenoh-ros2-sdk, in a process of its own.

    python -m tests.support.ros2_sdk_node PORT NODE_NAME

It takes commands as lines of JSON on its standard input, and reports what it hears as lines of JSON. It ends when its
input does.
"""

import json
import sys
import threading
import time
from typing import Any

from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2ServiceServer, ROS2Subscriber
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

from tests.support.ros2_output import tell

STRING = {"msg_type": "std_msgs/msg/String", "msg_definition": "string data\n"}
ADD = {
    "srv_type": "example_interfaces/srv/AddTwoInts",
    "request_definition": "int64 a\nint64 b\n",
    "response_definition": "int64 sum\n",
}
FLOAT = {"msg_type": "std_msgs/msg/Float64", "msg_definition": "float64 data\n"}
SET_BOOL = {
    "srv_type": "std_srvs/srv/SetBool",
    "request_definition": "bool data\n",
    "response_definition": "bool success\nstring message\n",
}
TYPES = {
    "srv_type": "rcl_interfaces/srv/GetParameterTypes",
    "request_definition": "string[] names\n",
    "response_definition": "uint8[] types\n",
}
LATCHED = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)


def until_served(client: ROS2ServiceClient) -> None:
    """As ``wait_for_service`` of ROS does, which the package lacks."""
    deadline = time.monotonic() + 60
    while not client.querier.matching_status.matching:
        assert time.monotonic() < deadline, "no node serves it"
        threading.Event().wait(0.02)


class Node:
    def __init__(self, port: int, name: str) -> None:
        self._common: dict[str, Any] = {"node_name": name, "router_port": port, "domain_id": 0}
        self._publishers: dict[str, ROS2Publisher] = {}
        self._kept: list[Any] = []

    def publish(self, topic: str, data: str) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = ROS2Publisher(topic=topic, **STRING, **self._common)
        self._publishers[topic].publish(data=data)

    def listen_to_numbers(self, topic: str) -> None:
        heard = ROS2Subscriber(
            topic=topic, callback=lambda it: tell("heard", topic=topic, data=it.data), **FLOAT, **self._common
        )
        self._kept.append(heard)

    def repeat(self, topic: str, value: float, hz: float) -> None:
        """Say a number again and again, as a joystick does, for as long as this process lives."""
        publisher = ROS2Publisher(topic=topic, **FLOAT, **self._common)

        def say() -> None:
            while True:
                publisher.publish(data=value)
                time.sleep(1 / hz)

        threading.Thread(target=say, daemon=True).start()

    def set_bool(self, service: str, data: bool) -> None:
        client = ROS2ServiceClient(service_name=service, timeout=20.0, **SET_BOOL, **self._common)
        self._kept.append(client)
        until_served(client)
        answer = client.call(data=data)
        if answer is None:
            tell("unanswered", service=service)
        else:
            tell("set", success=answer.success, message=answer.message)

    def listen(self, topic: str, latched: bool = False) -> None:
        qos = {"qos": LATCHED} if latched else {}
        heard = ROS2Subscriber(
            topic=topic, callback=lambda it: tell("heard", topic=topic, data=it.data), **STRING, **qos, **self._common
        )
        self._kept.append(heard)
        tell("listening", topic=topic)

    def serve(self, service: str, fails: bool = False, hangs: bool = False) -> None:
        def add(request: Any) -> Any:
            tell("asked", a=request.a, b=request.b)
            if hangs:
                threading.Event().wait()
            if fails:
                raise ValueError("no sums today")
            return server.response_msg_class(sum=request.a + request.b)

        server = ROS2ServiceServer(service_name=service, callback=add, **ADD, **self._common)
        self._kept.append(server)
        tell("serving", service=service)

    def add(self, service: str, a: int, b: int) -> None:
        client = ROS2ServiceClient(service_name=service, timeout=20.0, **ADD, **self._common)
        self._kept.append(client)
        until_served(client)
        answer = client.call(a=a, b=b)
        tell("added", sum=None if answer is None else answer.sum)

    def parameter_types(self, node: str, names: list[str]) -> None:
        client = ROS2ServiceClient(service_name=f"{node}/get_parameter_types", timeout=20.0, **TYPES, **self._common)
        self._kept.append(client)
        until_served(client)
        answer = client.call(names=names)
        tell("types", types=None if answer is None else [int(each) for each in answer.types])


def main() -> None:
    node = Node(int(sys.argv[1]), sys.argv[2])
    tell("ready")
    for line in sys.stdin:
        asked = json.loads(line)
        getattr(node, asked.pop("do"))(**asked)


if __name__ == "__main__":
    main()
