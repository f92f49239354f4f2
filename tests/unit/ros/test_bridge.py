"""Services, locks and sessions for nodes of ROS: they do what they may, and leave nothing behind that moves."""

import time
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.unit.ros.memory_graph import MemoryRos
from tests.unit.ros.robots import PATIENCE_S, Stand, apart
from trade import service, where
from trade.errors import AccessDenied
from trade_drivers.testing import FakeGripper
from trade_gateway.ros._graph import RosRefused

pytestmark = pytest.mark.virtual_time

TRIGGERS = '[[to_ros.service]]\ngroup = "rosie"\ntype = "std_srvs/srv/Trigger"\n'
SWITCHES = '[[to_ros.service]]\ngroup = "rosie.head"\ntype = "std_srvs/srv/SetBool"\n'
LOCKS = '[[to_ros.lock]]\ngroup = "rosie.head"\n'


def test_all_services_of_a_group_that_a_type_fits_are_offered(stand: Stand) -> None:
    stand.up(TRIGGERS + SWITCHES)
    node = stand.node()
    assert set(stand.ros.services) == {
        *(f"/rosie/{part}/{name}" for part in ("head", "legs") for name in ("state", "angle_rad", "spin", "stop")),
        "/rosie/head/power",
    }
    assert stand.trigger(node, "/rosie/head/state") == {"success": True, "message": '{"position_rad":0.0}'}
    assert stand.set_bool(node, "/rosie/head/power", True) == {"success": True, "message": ""}
    assert stand.robot.head.commands == [1.0]
    assert "service /rosie/head/stop is rosie.head.stop" in stand.said


def test_services_come_and_go_with_their_providers(stand: Stand) -> None:
    stand.up(TRIGGERS)
    stand.robot.container.deregister(stand.robot.legs)
    wait_until(lambda: not any(name.startswith("/rosie/legs") for name in stand.ros.services))
    stand.robot.container.register(stand.robot.legs, "rosie.legs")
    wait_until(lambda: "/rosie/legs/stop" in stand.ros.services)


def test_a_type_of_ones_own_carries_arguments_and_results_by_name(stand: Stand) -> None:
    folder = stand.folder / "types" / "my_robot" / "srv"
    folder.mkdir(parents=True)
    words = ["float64 angle_rad", "float64 speed", "---", "bool success", "string message", "float64 at"]
    (folder / "Turn.srv").write_text("\n".join(words))
    stand.ros = MemoryRos(folders=[stand.folder / "types"])
    stand.up(
        '[[to_ros.service]]\nservice = "rosie.head.turn"\ntype = "my_robot/srv/Turn"\nname = "/look"\n'
        'args = { speed_rad_s = "speed" }\n'
    )
    request = {"angle_rad": 0.25, "speed": 2.0}
    answer = stand.node().call("/look", "my_robot/srv/Turn", request, PATIENCE_S)
    assert answer == {"success": True, "message": "", "at": 0.25}


def test_a_failure_is_reported_in_the_response_or_as_a_ros_error(stand: Stand) -> None:
    stand.up(TRIGGERS + '[[to_ros.service]]\nservice = "rosie.legs.state"\ntype = "std_srvs/srv/Empty"\nname="/ask"\n')
    stand.robot.head.silent = stand.robot.legs.silent = True
    answer = stand.trigger(stand.node(), "/rosie/head/state")
    assert answer == {"success": False, "message": "TimeoutError: nothing was heard of it"}
    with pytest.raises(RosRefused, match="nothing was heard of it"):
        stand.node("/other").call("/ask", "std_srvs/srv/Empty", {}, PATIENCE_S)


def test_a_call_denied_by_the_policy_is_refused_with_access_denied(stand: Stand, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text(
        '[roles.robot]\nregister = ["rosie"]\n[roles.bridge]\nregister = ["ros"]\nread = ["rosie"]\n'
        '[identities]\nrobot = ["robot"]\nbridge = ["bridge"]\n'
    )
    for container in (stand.robot.container, stand.container):
        container.load_policy(policy)
    stand.up(TRIGGERS)
    node = stand.node()
    assert stand.trigger(node, "/rosie/head/state")["success"]
    answer = stand.trigger(node, "/rosie/head/spin")
    assert not answer["success"]
    assert answer["message"].startswith("AccessDenied: ")
    assert not stand.robot.head.goes.is_set()


def test_a_bridge_that_may_not_say_what_it_does_is_not_begun(stand: Stand, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text('[roles.robot]\nregister = ["rosie"]\n[identities]\nrobot = ["robot"]\n')
    stand.container.load_policy(policy)
    with pytest.raises(AccessDenied, match="register"):
        stand.up(TRIGGERS)


def test_S03_what_a_node_moves_stops_when_it_dies_and_nothing_else(stand: Stand) -> None:
    stand.up(TRIGGERS)
    one, other = stand.node("/one"), stand.node("/other")
    spins, _ = apart(lambda: stand.trigger(one, "/rosie/head/spin"))
    also, _ = apart(lambda: stand.trigger(other, "/rosie/legs/spin"))
    assert stand.robot.head.goes.wait(PATIENCE_S)
    assert stand.robot.legs.goes.wait(PATIENCE_S)
    stand.ros.kill("/one")
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    wait_until(lambda: [lock.resources for lock in stand.container.locks()] == [("legs",)])
    assert not stand.robot.legs.stopped.is_set()
    stand.robot.legs.stopped.set()
    spins.join(PATIENCE_S)
    also.join(PATIENCE_S)


def test_S03_a_lock_of_a_node_falls_with_it(stand: Stand) -> None:
    stand.up(TRIGGERS + LOCKS)
    node, other = stand.node("/one"), stand.node("/other")
    assert stand.set_bool(node, "/rosie/head/lock", True) == {"success": True, "message": "head"}
    [lock] = stand.container.locks()
    assert "one" in lock.holder.session
    answer = stand.trigger(other, "/rosie/head/spin")
    assert answer["message"].startswith("LockedByOther: ")
    stand.ros.kill("/one")
    wait_until(lambda: stand.container.locks() == [])


def test_a_lock_is_taken_and_given_back_and_serves_the_calls_of_its_node(stand: Stand) -> None:
    stand.up(SWITCHES + LOCKS)
    node = stand.node()
    assert stand.set_bool(node, "/rosie/head/lock", True)["success"]
    assert stand.set_bool(node, "/rosie/head/lock", True) == {"success": True, "message": "it has head"}
    assert stand.set_bool(node, "/rosie/head/power", True)["success"]
    assert len(stand.container.locks()) == 1
    assert stand.set_bool(node, "/rosie/head/lock", False) == {"success": True, "message": "released"}
    assert stand.container.locks() == []
    assert stand.set_bool(node, "/rosie/head/lock", False)["message"] == "it had none"


def test_a_node_whose_lock_was_broken_is_refused_and_can_lock_again(stand: Stand) -> None:
    stand.up(SWITCHES + LOCKS)
    node = stand.node()
    assert stand.set_bool(node, "/rosie/head/lock", True)["success"]
    stand.robot.container.break_lock(where(group="rosie.head"), "mine")
    wait_until(lambda: not stand.set_bool(node, "/rosie/head/power", True)["success"])
    assert stand.robot.head.commands == []
    wait_until(lambda: stand.set_bool(node, "/rosie/head/lock", True)["message"] == "head")  # it has heard by now
    assert stand.set_bool(node, "/rosie/head/power", True) == {"success": True, "message": ""}


def test_an_unidentified_node_cannot_take_a_lock(stand: Stand) -> None:
    stand.up(LOCKS + TRIGGERS)
    stand.ros.anonymous = True
    answer = stand.set_bool(stand.node(), "/rosie/head/lock", True)
    assert not answer["success"]
    assert "ROS does not identify the caller" in answer["message"]
    assert stand.trigger(stand.node(), "/rosie/head/state")["success"]


def test_S03_a_node_that_ros_does_not_list_soon_counts_as_gone(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trade_gateway.ros._nodes._UNSEEN_S", 0.2)
    stand.up(LOCKS)
    ghost = stand.ros.graph("/ghost", seen=False)
    assert stand.set_bool(ghost, "/rosie/head/lock", True)["success"]
    wait_until(lambda: stand.container.locks() == [])
    assert stand.set_bool(stand.node(), "/rosie/head/lock", True)["success"]


def test_nodes_that_ros_does_not_distinguish_are_one_client(stand: Stand) -> None:
    bridge = stand.up(TRIGGERS + SWITCHES)
    stand.ros.anonymous = True
    assert stand.set_bool(stand.node("/one"), "/rosie/head/power", True)["success"]
    assert stand.trigger(stand.node("/other"), "/rosie/head/stop")["success"]
    assert bridge.bridged().nodes == ["an unknown node of ROS"]


def test_while_a_node_moves_something_it_is_locked_against_others(stand: Stand) -> None:
    stand.up(TRIGGERS)
    spins, _ = apart(lambda: stand.trigger(stand.node(), "/rosie/head/spin"))
    assert stand.robot.head.goes.wait(PATIENCE_S)
    [lock] = stand.container.locks()
    assert (lock.resources, lock.holder.purpose) == (("head",), "a call of /teleop")
    stand.robot.head.stopped.set()
    spins.join(PATIENCE_S)
    assert stand.container.locks() == []


def test_what_others_have_locked_no_node_moves(stand: Stand) -> None:
    stand.up(TRIGGERS)
    person = stand.memory.container("person")
    stand.memory.settle()
    with person.lock(where(group="rosie.head"), purpose="to look"):
        answer = stand.trigger(stand.node(), "/rosie/head/spin")
    assert not answer["success"]
    assert "to look" in answer["message"]
    assert not stand.robot.head.goes.is_set()


def test_S07_a_stop_needs_no_lock_and_ends_what_others_move(stand: Stand) -> None:
    stand.up(TRIGGERS)
    person = stand.memory.container("person")
    stand.memory.settle()
    with person.lock(where(group="rosie.head")):
        run = person.find(where(name="spin", group="rosie.head")).start()
        assert stand.robot.head.goes.wait(PATIENCE_S)
        assert stand.trigger(stand.node(), "/rosie/head/stop")["success"]
        assert stand.robot.head.stopped.is_set()
        run.result(PATIENCE_S)


def test_S08_a_stop_from_another_node_blocks_all_nodes_until_resume(stand: Stand) -> None:
    stand.up(TRIGGERS + SWITCHES)
    spins, _ = apart(lambda: stand.trigger(stand.node("/one"), "/rosie/head/spin"))
    assert stand.robot.head.goes.wait(PATIENCE_S)
    stand.trigger(stand.node("/other"), "/rosie/head/stop")
    spins.join(PATIENCE_S)
    answer = stand.set_bool(stand.node("/one"), "/rosie/head/power", True)
    assert answer["message"].startswith("Stopped: ")
    stand.robot.container.resume(where(group="rosie.head"))
    assert stand.set_bool(stand.node("/one"), "/rosie/head/power", True)["success"]


def test_S09_an_e_stop_ends_what_nodes_move_and_holds_against_them(stand: Stand) -> None:
    stand.up(TRIGGERS + SWITCHES)
    node = stand.node()
    spins, ended = apart(lambda: stand.trigger(node, "/rosie/head/spin"))
    assert stand.robot.head.goes.wait(PATIENCE_S)
    report = stand.robot.container.estop("smoke")
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    spins.join(PATIENCE_S)
    assert ended
    assert stand.set_bool(node, "/rosie/head/power", True)["message"].startswith("Stopped: ")
    assert stand.trigger(node, "/rosie/head/state")["success"]
    stand.robot.container.estop_clear([report.id])


def test_when_ros_is_lost_all_that_its_nodes_move_stops_and_that_is_said(stand: Stand) -> None:
    bridge = stand.up(TRIGGERS + LOCKS)
    node = stand.node()
    assert stand.set_bool(node, "/rosie/head/lock", True)["success"]
    spins, _ = apart(lambda: stand.trigger(stand.node("/other"), "/rosie/legs/spin"))
    assert stand.robot.legs.goes.wait(PATIENCE_S)
    stand.ros.problem = "no router at tcp/127.0.0.1:7447"
    assert stand.robot.legs.stopped.wait(PATIENCE_S)
    spins.join(PATIENCE_S)
    wait_until(lambda: stand.container.locks() == [])
    [bridge_state] = stand.container.services(where(name="bridged", group="ros"))
    wait_until(lambda: bridge_state.health.startswith("ROS is lost: no router"))
    answer = stand.trigger(node, "/rosie/head/spin")
    assert "the end of /teleop would be invisible" in answer["message"]
    assert not stand.robot.head.goes.is_set()
    assert stand.trigger(node, "/rosie/head/stop")["success"]
    stand.ros.problem = ""
    wait_until(lambda: bridge_state.health == "healthy")
    assert stand.set_bool(node, "/rosie/head/lock", True)["success"]
    assert bridge.bridged().nodes == ["/teleop"]


def test_a_short_loss_within_the_grace_ends_nothing(stand: Stand) -> None:
    stand.up(LOCKS, "[ros]\nversion = 2\ngrace_s = 10\n")
    node = stand.node()
    assert stand.set_bool(node, "/rosie/head/lock", True)["success"]
    stand.ros.problem = "no router"
    assert stand.set_bool(node, "/rosie/head/lock", True)["message"] == "it has head"
    stand.ros.problem = ""
    assert len(stand.container.locks()) == 1


def test_of_two_mappings_with_one_name_the_first_gets_it_and_a_warning_says_so(stand: Stand) -> None:
    stand.up(TRIGGERS + TRIGGERS.replace('"rosie"', '"rosie.head"'))
    wait_until(lambda: any("rosie.head.stop cannot be mapped to /rosie/head/stop" in line for line in stand.said))
    assert stand.trigger(stand.node(), "/rosie/head/stop")["success"]


def test_what_does_not_fit_is_said_with_a_remedy(stand: Stand) -> None:
    bridge = stand.up('[[to_ros.service]]\nservice = "rosie.head.turn"\ntype = "std_srvs/srv/SetBool"\n')
    [problem] = bridge.bridged().problems
    assert "'data' is bool, which does not fit 'angle_rad'; it is turn(angle_rad: float" in problem
    assert stand.ros.services == {}


FLOAT, TRIGGER, GRIP = "std_msgs/msg/Float64", "std_srvs/srv/Trigger", "control_msgs/action/GripperCommand"
ABSENT = [
    ("joint_states", {"group": "rosie.eye"}, "no joints, arm or gripper for topic /joint_states"),
    ("trajectory", {"group": "rosie.eye", "action": "/go"}, "no joints or arm for action /go"),
    ("gripper", {"group": "rosie.eye", "action": "/grip"}, "no gripper for action /grip"),
    ("lock", {"group": "rosie.eye"}, "nothing to lock"),
    ("service", {"group": "rosie.eye", "type": "std_srvs/srv/SetBool"}, "no services that fit std_srvs/srv/SetBool"),
    ("service", {"service": "rosie.eye.luk", "type": TRIGGER}, f"no service luk for {TRIGGER}"),
    ("stream", {"service": "rosie.eye.luk", "topic": "/eye", "type": FLOAT}, "no service luk for topic /eye"),
    ("command", {"service": "rosie.eye.luk", "topic": "/do", "type": FLOAT}, "no service luk for topic /do"),
    ("action", {"service": "rosie.eye.luk", "action": "/do", "type": GRIP}, "no service luk for action /do"),
]


@pytest.mark.virtual_time
@pytest.mark.parametrize(("kind", "keys", "lacks"), ABSENT)
def test_an_entry_that_maps_nothing_in_a_group_with_services_is_a_problem(
    stand: Stand, kind: str, keys: dict[str, str], lacks: str
) -> None:
    stand.robot.container.register(Eye(), "rosie.eye")
    stand.memory.settle()
    bridge = stand.up(f"[[to_ros.{kind}]]\n" + "".join(f'{key} = "{value}"\n' for key, value in keys.items()))
    assert bridge.bridged().problems == []  # a robot may be starting
    wait_until(lambda: bridge.bridged().problems == [f"rosie.eye has {lacks}"])
    assert stand.said == [f"rosie.eye has {lacks}"]
    assert bridge.bridged().to_ros == {}


class Eye:
    @service(effect="read")
    def look(self) -> float:
        return 0.5


@pytest.mark.virtual_time
def test_an_entry_that_maps_nothing_is_no_problem_before_its_robot_is_up_and_after_it_has_what_is_wanted(
    stand: Stand,
) -> None:
    bridge = stand.up('[[to_ros.joint_states]]\ngroup = "rosie.eye"\n')
    time.sleep(20)
    assert bridge.bridged().problems == []
    stand.robot.container.register(Eye(), "rosie.eye")
    wait_until(lambda: bridge.bridged().problems)
    stand.robot.container.register(FakeGripper("rosie.eye.hand"), "rosie.eye.hand")
    wait_until(lambda: "topic /joint_states" in bridge.bridged().to_ros)
    wait_until(lambda: not bridge.bridged().problems)


def test_closing_the_bridge_stops_what_its_nodes_move(stand: Stand) -> None:
    bridge = stand.up(TRIGGERS)
    spins, _ = apart(lambda: stand.trigger(stand.node(), "/rosie/head/spin"))
    assert stand.robot.head.goes.wait(PATIENCE_S)
    bridge.close()
    assert stand.robot.head.stopped.wait(PATIENCE_S)
    spins.join(PATIENCE_S)
    assert stand.ros.services == {}
    assert stand.container.services(where(group="ros")) == []
