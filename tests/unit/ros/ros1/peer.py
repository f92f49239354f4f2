"""A rospy node of the tests, under the Python of ROS: does what it reads, writes what happens."""

import json
import sys
import threading
import time

import actionlib
import genpy
import roslib.message
import rospy
import yaml
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult

ENDLESS, ABORTS, HANGS = 0, -1, -2
opened: dict = {}
reported = threading.Lock()


def tell(event, what=None) -> None:
    with reported:
        print(json.dumps({"event": event, "what": what}), flush=True)


def fields(message):
    return yaml.safe_load(str(message)) or {}


def filled(kind, values):
    message = kind()
    for name, value in values.items():
        inner = getattr(message, name)
        is_filled = isinstance(inner, (roslib.message.Message, genpy.TVal))
        setattr(message, name, filled(type(inner), value) if is_filled else value)
    return message


def heard(message, topic) -> None:
    tell("heard", {"topic": topic, "who": message._connection_header["callerid"], **fields(message)})


def answered(request, how):
    if how == "fail":
        raise rospy.ServiceException("it is stuck")
    if how == "hang":
        rospy.sleep(3600)
    who = request._connection_header["callerid"]
    return {"success": True, "message": f"{who} asked {getattr(request, 'data', '')}"}


def pursued(server, goal) -> None:
    steps, rate = 0, rospy.Rate(50)
    if goal.goal == ABORTS:
        server.set_aborted(TestResult(goal.goal), "too far")
        return
    while goal.goal in (ENDLESS, HANGS) or steps < goal.goal:
        if server.is_preempt_requested() and goal.goal != HANGS:
            server.set_preempted(TestResult(steps), "as you wish")
            tell("preempted", goal.goal)
            return
        steps += 1
        server.publish_feedback(TestFeedback(steps))
        rate.sleep()
    server.set_succeeded(TestResult(goal.goal), "there")


class Rejects(actionlib.ActionServer):
    def __init__(self, name) -> None:
        super().__init__(
            name, TestAction, lambda handle: handle.set_rejected(TestResult(), "not now"), auto_start=False
        )


def advertise(topic, kind, latched=False) -> None:
    opened[topic] = rospy.Publisher(topic, roslib.message.get_message_class(kind), latch=latched, queue_size=100)


def send(topic, values) -> None:
    opened[topic].publish(filled(opened[topic].data_class, values))


def meet(topic) -> None:
    """Wait until a subscriber hears a topic of this node."""
    while not opened[topic].get_num_connections():
        time.sleep(0.01)
    tell("met", topic)


def repeat(topic, value, hz) -> None:
    """Say a number again and again, as a joystick does, for as long as this process lives."""
    advertise(topic, "std_msgs/Float64")

    def say() -> None:
        while True:
            send(topic, {"data": value})
            time.sleep(1 / hz)

    threading.Thread(target=say, daemon=True).start()


def hear(topic, kind) -> None:
    rospy.Subscriber(topic, roslib.message.get_message_class(kind), heard, topic)


def serve(name, kind, how="answer") -> None:
    rospy.Service(name, roslib.message.get_service_class(kind), lambda request: answered(request, how))


def call(name, kind, values) -> None:
    service = roslib.message.get_service_class(kind)
    try:
        rospy.wait_for_service(name, 30)
        tell("called", fields(rospy.ServiceProxy(name, service)(filled(service._request_class, values))))
    except (rospy.ServiceException, rospy.ROSException) as error:
        tell("failed", str(error))


def act(name) -> None:
    server = actionlib.SimpleActionServer(name, TestAction, lambda goal: pursued(server, goal), auto_start=False)
    server.start()
    opened[name] = server


def reject(name) -> None:
    opened[name] = Rejects(name)
    opened[name].start()


def pursue(name, number) -> None:
    client = opened.get(name) or opened.setdefault(name, actionlib.SimpleActionClient(name, TestAction))
    if not client.wait_for_server(rospy.Duration(30)):
        tell("failed", "there is no server")
        return

    def done(state, result) -> None:
        tell("done", {"goal": number, "state": state, "result": result.result, "text": client.get_goal_status_text()})

    client.send_goal(
        TestGoal(number),
        done_cb=done,
        active_cb=lambda: tell("active", number),
        feedback_cb=lambda feedback: tell("feedback", feedback.feedback),
    )


def cancel(name) -> None:
    opened[name].cancel_goal()


def main() -> None:
    rospy.init_node(sys.argv[1], disable_signals=True)
    tell("ready")
    for line in sys.stdin:
        what, *args = json.loads(line)
        if what == "end":
            break
        job = globals()[what]
        if what in ("call", "pursue"):
            threading.Thread(target=job, args=args, daemon=True).start()
        else:
            job(*args)
            tell("did", what)
    rospy.signal_shutdown("requested")


main()
