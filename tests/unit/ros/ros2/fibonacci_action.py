"""Actions of ROS 2 in tests: the keys and bytes that published facts give, and goals that go on.

Keys have the type hashes that ``rosidl`` made for ``example_interfaces/action/Fibonacci``.
"""

import struct
import threading
from collections.abc import Callable
from typing import Any

import zenoh

from tests.support.ros2_processes import until_served
from trade_gateway.ros._graph import ActionGoal, Goal, GoalEnd, Outcome
from trade_gateway.ros.ros2 import Ros2

FIBONACCI = "example_interfaces/action/Fibonacci"
LONG_S = 60.0
CDR = b"\0\1\0\0"
ID = bytes(range(1, 17))
OTHER = bytes(range(17, 33))
_PARTS = {
    "send_goal": (
        "example_interfaces::action::dds_::Fibonacci_SendGoal_",
        "RIHS01_d1a57fb2a4afe8c21e34fb10db206f16ce6729b28531141472df92277c55b557",
    ),
    "get_result": (
        "example_interfaces::action::dds_::Fibonacci_GetResult_",
        "RIHS01_1b0de0d5d29dc955d92f546706568428632771db13ec84c15ec1c1a59f424a57",
    ),
    "cancel_goal": (
        "action_msgs::srv::dds_::CancelGoal_",
        "RIHS01_573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a",
    ),
    "feedback": (
        "example_interfaces::action::dds_::Fibonacci_FeedbackMessage_",
        "RIHS01_c1de71afd52e49a89c53d8262366884185bc0a02f78ce051c4e46b0a7fe59bb2",
    ),
    "status": (
        "action_msgs::msg::dds_::GoalStatusArray_",
        "RIHS01_6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e",
    ),
}
ATTACHMENT = struct.pack("<qqB16s", 1, 1, 16, b"\xab" * 16)


def key(action: str, part: str) -> str:
    type_name, type_hash = _PARTS[part]
    return f"0/{action}/_action/{part}/{type_name}/{type_hash}"


def numbers(*values: int) -> bytes:
    return struct.pack(f"<I{len(values)}i", len(values), *values)


def ask(session: zenoh.Session, action: str, part: str, payload: bytes) -> bytes:
    until_served(session, key(action, part))
    replies = session.get(key(action, part), payload=CDR + payload, attachment=ATTACHMENT, timeout=LONG_S)
    (reply,) = list(replies)
    assert reply.ok is not None
    answer = reply.ok.payload.to_bytes()
    assert answer[:4] == CDR
    assert reply.ok.attachment is not None
    sequence, _, length, gid = struct.unpack("<qqB16s", reply.ok.attachment.to_bytes())
    assert (sequence, length, gid) == (1, 16, b"\xab" * 16)
    return answer[4:]


def pursue(graph: Ros2, action: str, order: int, feedback: Callable[[Any], object] | None = None) -> ActionGoal:
    for part in ("send_goal", "cancel_goal", "get_result"):
        until_served(graph._link.session, key(action, part))
    return graph.pursue(f"/{action}", FIBONACCI, {"order": order}, feedback)


class Doing:
    """Goals that run until the test ends them, or a client cancels them."""

    def __init__(self) -> None:
        self.goals: list[Any] = []
        self.go_on = threading.Event()

    def __call__(self, goal: Goal) -> Outcome:
        ended = threading.Event()
        canceled = threading.Event()
        goal.when_canceled(lambda: (canceled.set(), ended.set()))
        self.goals.append(goal)
        goal.feedback({"sequence": [0, 1]})
        while not ended.is_set() and not self.go_on.wait(0.02):
            pass
        sequence = [goal.message["order"]]
        return Outcome(GoalEnd.CANCELED if canceled.is_set() else GoalEnd.SUCCEEDED, {"sequence": sequence})
