"""Stops and the end of a caller overtake what waits for its turn; a stop is repeated until it is heard."""

import threading
import time
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.ros.robots import PATIENCE_S, Stand, apart
from trade import Handle, where
from trade.errors import MotionStopped, TradeError
from trade_gateway.ros._graph import RosUnreachable

pytestmark = pytest.mark.virtual_time

TRIGGERS = '[[to_ros.service]]\ngroup = "rosie"\ntype = "std_srvs/srv/Trigger"\n'
SPIN, STOP = "/rosie/head/spin", "/rosie/head/stop"
TWIST = "geometry_msgs/msg/Twist"
DRIVE = (
    '[[from_ros.publish]]\ntopic = "/cmd_vel"\ntype = "geometry_msgs/msg/Twist"\ngroups = ["base"]\n'
    'effect = "actuate"\nstop = {}\nname = "drive"\nvalid_s = 0\n'
)
DOOR = (
    '[[from_ros.service]]\nservice = "/lab/door"\ntype = "std_srvs/srv/SetBool"\ngroups = ["lab"]\n'
    'effect = "actuate"\nstop = "/lab/stop"\n'
)


def found(stand: Stand, group: str, name: str) -> Handle:
    return stand.robot.container.find(where(group=group, name=name), wait_s=PATIENCE_S)


def test_S08_what_a_node_asked_for_before_its_stop_does_not_begin_after_it(stand: Stand) -> None:
    stand.up(TRIGGERS)
    node = stand.node()
    first, _ = apart(lambda: stand.trigger(node, SPIN))
    assert stand.robot.head.goes.wait(PATIENCE_S)
    second, reported = apart(lambda: stand.trigger(node, SPIN))
    wait_until(lambda: stand.ros.services[SPIN].asked == 2)
    assert stand.trigger(node, STOP)["success"]
    first.join(PATIENCE_S)
    second.join(PATIENCE_S)
    assert stand.robot.head.spins == 1
    assert not reported[0]["success"]


def test_S03_what_waited_for_its_turn_when_its_node_died_does_not_begin(stand: Stand) -> None:
    stand.up(TRIGGERS)
    one, other = stand.node("/one"), stand.node("/other")
    first, _ = apart(lambda: stand.trigger(one, SPIN))
    assert stand.robot.head.goes.wait(PATIENCE_S)
    apart(lambda: stand.trigger(other, SPIN))
    wait_until(lambda: stand.ros.services[SPIN].asked == 2)
    stand.ros.kill("/other")
    stand.trigger(one, STOP)
    first.join(PATIENCE_S)
    wait_until(lambda: stand.ros.services[SPIN].answered == 2)
    assert stand.robot.head.spins == 1


def test_a_topic_is_no_way_to_a_stop(stand: Stand) -> None:
    stand.up('[[to_ros.command]]\ntopic = "/halt"\ntype = "std_msgs/msg/Empty"\nservice = "rosie.head.stop"\n')
    wait_until(lambda: any("Use [[to_ros.service]]" in line for line in stand.said))


def test_S14_while_ros_is_lost_stops_stay_pending_and_its_devices_count_as_moving(stand: Stand) -> None:
    bridge = stand.up(DRIVE)
    heard: list[Any] = []
    stand.node("/base").subscribe("/cmd_vel", TWIST, lambda message, _who: heard.append(message["linear"]["x"]))
    found(stand, "base", "drive")({"x": 0.5}, {})
    wait_until(lambda: heard == [0.5])
    stand.ros.problem = "no master"
    with pytest.raises(RosUnreachable, match="as soon as ROS is back"):
        found(stand, "base", "stop")()
    me = stand.robot.container
    with pytest.raises(TradeError):
        me.lock(where(group="base"), wait_s=0).acquire()
    stand.ros.problem = ""
    wait_until(lambda: bridge is stand.bridge and heard[-1] == 0.0)
    with me.lock(where(group="base"), wait_s=PATIENCE_S):
        assert heard[-1] == 0.0


def test_S08_a_stop_that_overtook_a_pending_call_is_sent_again(stand: Stand) -> None:
    lab, arrive, asked, stops = stand.node("/lab"), threading.Event(), threading.Event(), list[float]()

    def move(_request: Any, _who: str, _came_at: float) -> Any:
        asked.set()
        arrive.wait(PATIENCE_S)
        return {"success": True, "message": "moves"}

    def stop(_request: Any, _who: str, came_at: float) -> Any:
        stops.append(came_at)
        return {"success": True}

    lab.serve("/lab/door", "std_srvs/srv/SetBool", move)
    lab.serve("/lab/stop", "std_srvs/srv/Trigger", stop)
    stand.up(DOOR)
    moves, ended = apart(lambda: found(stand, "lab", "door").with_(deadline_s=PATIENCE_S)(True))
    assert asked.wait(PATIENCE_S)
    found(stand, "lab", "stop")()
    assert len(stops) == 1
    arrive.set()
    moves.join(PATIENCE_S)
    assert len(stops) == 2
    assert isinstance(ended[0], MotionStopped)


def test_nothing_begins_for_a_node_once_the_bridge_is_leaving(stand: Stand) -> None:
    bridge = stand.up(TRIGGERS)
    bridge.close()
    with pytest.raises(RosUnreachable, match="shutting down"):
        bridge._nodes.guest("/late", time.monotonic())
