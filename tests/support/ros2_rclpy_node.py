"""Nodes of rclpy, run by the Python of a ROS 2 installation. The words say what one does; it reports in JSON."""

import json
import sys
import time

import rclpy
from control_msgs.action import FollowJointTrajectory, GripperCommand
from geometry_msgs.msg import Twist
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectoryPoint


def say(what, **more):
    """Report."""
    print(json.dumps({"what": what, **more}), flush=True)


def serve(node, action, takes_s):
    """A gripper's action: each goal takes some seconds, unless it is canceled; a negative position is aborted."""

    def execute(goal):
        position, begun = goal.request.command.position, time.monotonic()
        say("goal", position=position, max_effort=goal.request.command.max_effort)
        while time.monotonic() < begun + float(takes_s):
            goal.publish_feedback(GripperCommand.Feedback(position=0.5 * position))
            if goal.is_cancel_requested:
                goal.canceled()
                say("canceled")
                return GripperCommand.Result(position=0.5 * position)
            time.sleep(0.02)
        goal.succeed() if position >= 0 else goal.abort()
        return GripperCommand.Result(position=position, reached_goal=position >= 0)

    return ActionServer(
        node,
        GripperCommand,
        action,
        execute,
        callback_group=ReentrantCallbackGroup(),
        cancel_callback=lambda _: CancelResponse.ACCEPT,
    )


def grip(node, action, position):
    """One goal for a gripper."""
    goal = GripperCommand.Goal()
    goal.command.position = float(position)
    return pursue(node, GripperCommand, action, goal, lambda it: {"position": it.position, "stalled": it.stalled})


def follow(node, action, *joints):
    """One goal for joints: to 0.3 rad within 0.2 s."""
    goal = FollowJointTrajectory.Goal()
    goal.trajectory.joint_names = list(joints)
    for nanoseconds, angle in ((0, 0.0), (200_000_000, 0.3)):
        point = JointTrajectoryPoint(positions=[angle] * len(joints))
        point.time_from_start.nanosec = nanoseconds
        goal.trajectory.points.append(point)
    said = lambda it: {"error_code": it.error_code, "error_string": it.error_string}  # noqa: E731
    return pursue(node, FollowJointTrajectory, action, goal, said)


def pursue(node, kind, action, goal, said):
    """Send a goal; report whether it was accepted, and its end."""
    client = ActionClient(node, kind, action)
    client.wait_for_server()

    def accepted(future):
        say("accepted", accepted=future.result().accepted)
        if future.result().accepted:
            future.result().get_result_async().add_done_callback(ended)

    def ended(future):
        say("ended", status=future.result().status, **said(future.result().result))

    client.send_goal_async(goal).add_done_callback(accepted)
    return client


def push(node, topic, value):
    """A number, 20 times a second."""
    publisher = node.create_publisher(Float64, topic, 10)
    return node.create_timer(0.05, lambda: publisher.publish(Float64(data=float(value))))


def hold(node, service):
    """Switch something on, and stay."""
    client = node.create_client(SetBool, service)
    client.wait_for_service()
    asked = client.call_async(SetBool.Request(data=True))
    asked.add_done_callback(lambda it: say("held", success=it.result().success, message=it.result().message))
    return client


def lab(node):
    """A door that a service opens and another one halts, a level, a drive, and a parameter."""

    def door(request, response):
        say("door", data=request.data)
        response.success, response.message = True, "moved"
        return response

    def halt(_, response):
        say("halt")
        response.success = True
        return response

    node.declare_parameter("gain", 1.5)
    return [
        node.create_service(SetBool, "/lab/door", door),
        node.create_service(Trigger, "/lab/halt", halt),
        node.create_subscription(Twist, "/lab/drive", lambda it: say("drive", x=it.linear.x), 10),
        push(node, "/lab/level", 24.5),
    ]


def main():
    """Do what the words say, until the process is killed."""
    do, *words = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node(do)
    kept = {one.__name__: one for one in (serve, grip, follow, push, hold, lab)}[do](node, *words)
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    say("up", kept=kept is not None)
    executor.spin()


main()
