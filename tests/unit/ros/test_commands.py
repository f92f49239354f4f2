"""Commands by topic: the newest counts, one node at a time, and silence stops."""

from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.ros.robots import PATIENCE_S, Stand
from trade import where

pytestmark = pytest.mark.virtual_time

FLOAT = "std_msgs/msg/Float64"
COMMAND = '[[to_ros.command]]\ntopic = "/head"\ntype = "std_msgs/msg/Float64"\nservice = "rosie.head.go"\n'
LONG = COMMAND + "deadman_s = 10\n"
LOCK = '[[to_ros.lock]]\ngroup = "rosie.head"\n'


class Stick:
    """A node that commands."""

    def __init__(self, stand: Stand, name: str = "/teleop", topic: str = "/head", kind: str = FLOAT) -> None:
        self.graph = stand.node(name)
        self._publisher = self.graph.advertise(topic, kind)

    def say(self, value: Any, field: str = "data") -> None:
        self._publisher.send({field: value})


def test_a_message_moves_under_a_lock_and_the_newest_counts(stand: Stand) -> None:
    stand.up(LONG)
    stick = Stick(stand)
    stick.say(0.1)
    assert stand.robot.head.goes.wait(PATIENCE_S)
    [lock] = stand.container.locks()
    assert lock.holder.purpose == "commands of /teleop on /head"
    for number in range(2, 30):
        stick.say(number / 10)
    wait_until(lambda: stand.robot.head.commands[-1:] == [2.9])
    assert stand.robot.head.commands == sorted(stand.robot.head.commands)
    assert len(stand.container.locks()) == 1


def test_silence_stops_and_gives_the_lock_back(stand: Stand) -> None:
    stand.up(COMMAND)
    stick = Stick(stand)
    stick.say(0.1)
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    wait_until(lambda: stand.container.locks() == [])
    wait_until(lambda: any("no message on /head for 0.5 s; rosie.head.go was stopped" in x for x in stand.said))
    stand.robot.head.stopped.clear()

    def moves_again() -> bool:
        stick.say(0.2)  # as a stick does: one that comes while the head still comes to rest is refused
        return stand.robot.head.commands[-1] == 0.2

    wait_until(moves_again)
    assert (stand.robot.head.commands[0], set(stand.robot.head.commands[1:])) == (0.1, {0.2})


def test_S03_a_node_that_dies_stops_what_it_commanded_at_once(stand: Stand) -> None:
    stand.up(LONG)
    Stick(stand).say(0.1)
    assert stand.robot.head.goes.wait(PATIENCE_S)
    stand.ros.kill("/teleop")
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    wait_until(lambda: stand.container.locks() == [])


def test_S03_what_is_under_way_from_a_node_that_has_ended_moves_nothing(stand: Stand) -> None:
    stand.up(LONG)
    stick = Stick(stand)
    stick.say(0.1)
    assert stand.robot.head.goes.wait(PATIENCE_S)
    stand.ros.kill("/teleop")
    wait_until(lambda: stand.container.locks() == [])
    late = Stick(stand, "/teleop-again")
    late.graph.node = "/teleop"  # its last words, which were on the way
    late.say(0.2)
    wait_until(lambda: any("it has ended" in line for line in stand.said))
    assert stand.robot.head.commands == [0.1]


def test_while_one_node_commands_another_one_is_not_heard(stand: Stand) -> None:
    stand.up(LONG)
    Stick(stand).say(0.1)
    assert stand.robot.head.goes.wait(PATIENCE_S)
    Stick(stand, "/other").say(0.9)
    wait_until(lambda: any("/other is refused on /head: /teleop commands there" in line for line in stand.said))
    assert stand.robot.head.commands == [0.1]


def test_what_others_have_locked_is_not_commanded_and_that_is_said(stand: Stand) -> None:
    stand.up(COMMAND)
    person = stand.memory.container("person")
    stand.memory.settle()
    with person.lock(where(group="rosie.head"), purpose="to look"):
        Stick(stand).say(0.1)
        wait_until(lambda: any("LockedByOther" in line and "to look" in line for line in stand.said))
    assert stand.robot.head.commands == []
    assert stand.robot.head.stops == 0


def test_a_lock_that_the_node_has_taken_serves_its_commands_and_outlasts_them(stand: Stand) -> None:
    stand.up(COMMAND + LOCK)
    stick = Stick(stand)
    assert stand.set_bool(stick.graph, "/rosie/head/lock", True)["success"]
    stick.say(0.1)
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    wait_until(lambda: any("was stopped" in line for line in stand.said))
    assert len(stand.container.locks()) == 1


def test_a_call_that_fails_stops_and_gives_the_lock_back(stand: Stand) -> None:
    stand.up(LONG)
    stick = Stick(stand)
    stick.say(0.1)
    assert stand.robot.head.goes.wait(PATIENCE_S)
    stick.say(float("nan"))
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    wait_until(lambda: stand.container.locks() == [])
    wait_until(lambda: any("InvalidArgument" in line for line in stand.said))
    assert stand.robot.head.commands == [0.1]


def test_S08_a_stop_by_another_client_blocks_ros_commands_until_resume(stand: Stand) -> None:
    stand.up(LONG)
    stick = Stick(stand)
    stick.say(0.1)
    assert stand.robot.head.goes.wait(PATIENCE_S)
    person = stand.memory.container("person")
    stand.memory.settle()
    person.find(where(name="stop", group="rosie.head"))()
    stand.robot.head.stopped.clear()
    wait_until(lambda: stand.container.locks() == [] or (stick.say(0.2), False)[1])
    stick.say(0.3)
    wait_until(lambda: any("Stopped: " in line for line in stand.said))
    assert 0.3 not in stand.robot.head.commands


def test_when_ros_is_lost_commands_end(stand: Stand) -> None:
    stand.up(LONG)
    stick = Stick(stand)
    stick.say(0.1)
    assert stand.robot.head.goes.wait(PATIENCE_S)
    stand.ros.problem = "no master"
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    wait_until(lambda: stand.container.locks() == [])
    stick.say(0.2)
    wait_until(lambda: any("the end of /teleop would be invisible" in line for line in stand.said))
    assert stand.robot.head.commands == [0.1]


def test_what_cannot_be_stopped_is_not_commanded_by_topic(stand: Stand) -> None:
    class Lamp:
        from trade import service

        @service
        def dim(self, level: float) -> None:
            """Dim it."""

    stand.robot.container.register(Lamp(), "rosie.lamp")
    stand.memory.settle()
    bridge = stand.up(COMMAND.replace("head.go", "lamp.dim"))
    assert "rosie.lamp.dim: has no stop" in bridge.bridged().problems[0]


@pytest.mark.parametrize("close", ["bridge", "provider"])
def test_the_end_of_either_side_stops(stand: Stand, close: str, tmp_path: Path) -> None:
    bridge = stand.up(LONG)
    Stick(stand).say(0.1)
    assert stand.robot.head.goes.wait(PATIENCE_S)
    if close == "bridge":
        bridge.close()
    else:
        stand.robot.container.deregister(stand.robot.head)
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    wait_until(lambda: stand.ros.topics["/head"] == [])
