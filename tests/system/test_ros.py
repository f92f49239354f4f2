"""``trade ros`` between a simulated robot and nodes of ROS 1 and ROS 2, which die and come back in the middle.

The nodes are rospy of the distribution; a package of other hands that speaks rmw_zenoh, and does not say who it is; and
a node of our own that says so as rmw_zenoh does. The judge of motion is the simulator's log.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

import pytest

import trade
from tests.support.ros1_system import Peer, need_ros1
from tests.support.ros1_system import Stand as Ros1Stand
from tests.support.ros2_processes import Process, Router, free_port
from tests.support.waiting import wait_until
from tests.system.conftest import Bench, Program
from trade import Handle, errors, where
from trade_hil_sim import events, writes

FAR_RAD = 1.2
HALFWAY_RAD = 0.6
"""Where a joint that is not stopped gets to long after everything that stops it should have."""
FILE = """
[ros]
{ros}

[[to_ros.lock]]
group = "rosie.neck.pan"

[[to_ros.command]]
topic = "/pan"
type = "std_msgs/msg/Float64"
service = "rosie.neck.pan.move_to"
args = {{ position_rad = "data" }}
fixed = {{ speed_rad_s = 0.05 }}
deadman_s = 10
deadline_s = 100

[[to_ros.command]]
topic = "/pan_by_hand"
type = "std_msgs/msg/Float64"
service = "rosie.neck.pan.move_to"
args = {{ position_rad = "data" }}
fixed = {{ speed_rad_s = 0.05 }}
deadman_s = 0.5
deadline_s = 100

[[from_ros.topic]]
topic = "/battery"
type = "std_msgs/msg/Float64"
groups = ["base.battery"]
name = "voltage"
stale_after_s = 2
"""

Run = Callable[..., Program]


class Node(Protocol):
    """Of ROS, in a process of its own."""

    def repeat(self, topic: str, value: float, hz: float) -> None: ...
    def set_bool(self, service: str, value: bool) -> tuple[bool, str]: ...
    def kill(self) -> None: ...


class Ros(Protocol):
    """A ROS system."""

    settings: str

    def node(self, name: str) -> Node: ...
    def kill_core(self) -> None: ...
    def start_core(self) -> None: ...


class Ros1Node:
    def __init__(self, peer: Peer) -> None:
        self._peer = peer

    def repeat(self, topic: str, value: float, hz: float) -> None:
        self._peer.do("repeat", topic, value, hz)

    def set_bool(self, service: str, value: bool) -> tuple[bool, str]:
        before = len(self._peer.all("called"))
        self._peer.do("call", service, "std_srvs/SetBool", {"data": value})
        wait_until(lambda: len(self._peer.all("called")) > before, f"{service} answers")
        reported = self._peer.all("called")[-1]
        return reported["success"], reported["message"]

    def kill(self) -> None:
        self._peer.end()


class Ros1System:
    def __init__(self, folder: Path) -> None:
        need_ros1()
        self._stand = Ros1Stand(folder / "home")
        self.settings = f'version = 1\nmaster = "{self._stand.uri}"'
        self.start_core = self._stand.start_master
        self.kill_core = self._stand.kill_master
        self.close = self._stand.close

    def node(self, name: str) -> Node:
        return Ros1Node(self._stand.peer(name))


class Ros2Node:
    def __init__(self, process: Process) -> None:
        self._process = process

    def repeat(self, topic: str, value: float, hz: float) -> None:
        self._process.ask("repeat", topic=topic, value=value, hz=hz)

    def set_bool(self, service: str, value: bool) -> tuple[bool, str]:
        before = len(self._process.has("set"))
        self._process.ask("set_bool", service=service, data=value)
        wait_until(lambda: len(self._process.has("set")) > before, f"{service} answers")
        reported = self._process.has("set")[-1]
        return reported["success"], reported["message"]

    def kill(self) -> None:
        self._process.kill()


class Ros2System:
    script = "ros2_graph_node"

    def __init__(self, folder: Path) -> None:
        self._port = free_port()
        self._router = Router(self._port)
        self._nodes: list[Process] = []
        self.settings = f'version = 2\nrouter = "{self._router.endpoint}"'
        self.start_core = self._router.start
        self.kill_core = self._router.kill

    def node(self, name: str) -> Node:
        return Ros2Node(self.process(name))

    def process(self, name: str) -> Process:
        self._nodes.append(Process(self.script, self._port, name))
        return self._nodes[-1]

    def close(self) -> None:
        for node in self._nodes:
            node.kill()
        self._router.kill()


class Ros2OfOthers(Ros2System):
    script = "ros2_sdk_node"


def _system(kind: Any, folder: Path) -> Iterator[Ros]:
    made = kind(folder)
    made.start_core()
    yield made
    made.close()


@pytest.fixture(params=[Ros1System, Ros2System, Ros2OfOthers], ids=["ros1", "ros2", "ros2 of others"])
def ros(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Ros]:
    yield from _system(request.param, tmp_path)


known = pytest.mark.parametrize("ros", [Ros1System, Ros2System], ids=["ros1", "ros2"], indirect=True)
"""Those that say who they are."""
unknown = pytest.mark.parametrize("ros", [Ros2OfOthers], ids=["ros2 of others"], indirect=True)


class Bridged:
    """Rosie's head, simulated, and ``trade ros``."""

    def __init__(self, bench: Bench, ros: Ros, run: Run, file: Path) -> None:
        self.bench = bench
        self.ros = ros
        file.write_text(FILE.format(ros=ros.settings))
        self._up = lambda: run("-m", "trade_gateway", "ros", file)
        self.restart()

    def restart(self) -> None:
        """Start the bridge; who ran before must have ended."""
        self.program = self._up()
        while "bridged:" not in self.program.line():
            pass

    def begun(self, since: float = 0.0) -> None:
        wait_until(lambda: bool(events(self.bench.sim.entries(), "motion_started", device_id=1, since=since)))

    def stopped(self, since: float) -> None:
        self.bench.stopped_short(since, HALFWAY_RAD)

    def got_no_goal(self, since: float) -> bool:
        return not writes(self.bench.sim.entries(), device_id=1, register="goal_position", since=since)


@pytest.fixture
def bridged(ros: Ros, bench: Bench, run: Run, tmp_path: Path) -> Bridged:
    return Bridged(bench, ros, run, tmp_path / "ros.toml")


def _pan(name: str) -> Handle:
    return trade.find(where(name=name, group="rosie.neck.pan"), wait_s=30)


@known
def test_S03_the_motion_of_a_killed_node_stops_and_the_next_node_moves_again(bridged: Bridged) -> None:
    node = bridged.ros.node("teleop")
    node.repeat("/pan", FAR_RAD, 10)
    bridged.begun()
    [lock] = trade.locks()
    assert lock.holder.purpose == "commands of /teleop on /pan"
    killed_at = time.monotonic()
    node.kill()
    bridged.stopped(killed_at)
    wait_until(lambda: trade.locks() == [], "its lock falls")
    again_at = time.monotonic()
    bridged.ros.node("teleop").repeat("/pan", FAR_RAD, 10)
    bridged.begun(again_at)


@pytest.mark.parametrize("killed", ["core", "bridge"])
def test_S03_what_nodes_move_stops_when_the_core_or_the_bridge_is_killed_and_can_be_moved_with_the_next_one(
    bridged: Bridged, killed: str
) -> None:
    bridged.ros.node("teleop").repeat("/pan_by_hand", FAR_RAD, 10)
    bridged.begun()
    killed_at = time.monotonic()
    kill, start = {
        "core": (bridged.ros.kill_core, bridged.ros.start_core),
        "bridge": (bridged.program.process.kill, bridged.restart),
    }[killed]
    kill()
    bridged.stopped(killed_at)
    if killed == "core":
        wait_until(lambda: trade.locks() == [])
    again_at = time.monotonic()
    start()
    bridged.begun(again_at)  # it still says so


@unknown
def test_S03_the_motion_of_an_unidentified_node_stops_when_the_node_falls_silent(bridged: Bridged) -> None:
    node = bridged.ros.node("teleop")
    node.repeat("/pan_by_hand", FAR_RAD, 20)
    bridged.begun()
    killed_at = time.monotonic()
    node.kill()
    bridged.stopped(killed_at)
    wait_until(lambda: trade.locks() == [], "its lock falls")
    success, said = bridged.ros.node("owner").set_bool("/rosie/neck/pan/lock", True)
    assert not success
    assert "does not identify the caller" in said
    again_at = time.monotonic()
    bridged.ros.node("teleop").repeat("/pan_by_hand", FAR_RAD, 20)
    bridged.begun(again_at)


@known
def test_a_local_lock_holds_against_ros_and_a_ros_lock_against_local_callers(bridged: Bridged) -> None:
    move = _pan("move_to")
    node = bridged.ros.node("teleop")
    locked_at = time.monotonic()
    with trade.lock([move], purpose="mine"):
        node.repeat("/pan_by_hand", FAR_RAD, 10)
        success, said = node.set_bool("/rosie/neck/pan/lock", True)
        assert not success
        assert "mine" in said
        assert bridged.got_no_goal(locked_at)
    bridged.begun(locked_at)
    killed_at = time.monotonic()
    node.kill()
    bridged.stopped(killed_at)
    other = bridged.ros.node("owner")
    success, said = other.set_bool("/rosie/neck/pan/lock", True)
    assert success, said
    with pytest.raises(errors.LockedByOther, match="/owner"):
        move(0.0)
    other.kill()
    wait_until(lambda: trade.locks() == [], "its lock falls")
    move(0.0)


def test_what_a_node_publishes_is_a_service_that_says_when_it_is_stale(bridged: Bridged) -> None:
    node = bridged.ros.node("base")
    node.repeat("/battery", 24.5, 20)
    voltage = trade.find(where(name="voltage", group="base.battery"), wait_s=30)

    def says(value: float) -> Callable[[], bool]:
        def now() -> bool:
            try:
                reported: Any = voltage()
            except errors.TradeError:
                return False
            return reported.data == value

        return now

    wait_until(says(24.5), "the voltage is published")
    node.kill()

    def stale() -> bool:
        try:
            voltage()
        except errors.TradeError as error:
            return "s ago" in str(error) or "no message" in str(error)
        return False

    wait_until(stale, "it is stale")
    bridged.ros.node("base").repeat("/battery", 23.0, 20)
    wait_until(says(23.0), "the next one is published")


MIXED_1 = """
[ros]
{ros}

[[from_ros.topic]]
topic = "/battery"
type = "std_msgs/msg/Float64"
groups = ["base.battery"]
name = "voltage"

[[to_ros.lock]]
group = "rosie.hand"
"""
MIXED_2 = """
[ros]
{ros}

[[to_ros.stream]]
service = "base.battery.voltage"
topic = "/battery_of_ros1"
type = "std_msgs/msg/Float64"
hz = 10

[[to_ros.stream]]
service = "rosie.hand.state"
topic = "/width"
type = "std_msgs/msg/Float64"
fields = {{ data = "width_m" }}
"""


def test_P08_c_python_ros_1_and_ros_2_are_side_by_side_in_one_system(run: Run, tmp_path: Path, c_gripper: Path) -> None:
    with ExitStack() as undo:
        one, two = Ros1System(tmp_path), Ros2OfOthers(tmp_path)
        for ros, text, name in ((one, MIXED_1, "one"), (two, MIXED_2, "two")):
            undo.callback(ros.close)
            ros.start_core()
            (tmp_path / f"{name}.toml").write_text(text.format(ros=ros.settings))
        assert "rosie.hand is registered" in run(c_gripper).line()
        for name in ("one", "two"):
            program = run("-m", "trade_gateway", "ros", tmp_path / f"{name}.toml", "--name", name)
            while "bridged:" not in program.line():
                pass
        base, screen = one.node("base"), two.process("screen")
        base.repeat("/battery", 24.5, 20)
        screen.ask("listen_to_numbers", topic="/battery_of_ros1")
        screen.ask("listen_to_numbers", topic="/width")
        screen.hear("heard", topic="/battery_of_ros1", data=24.5)
        success, said = base.set_bool("/rosie/hand/lock", True)
        assert success, said
        move = trade.find(where(name="move_to", group="rosie.hand"), wait_s=30)
        with pytest.raises(errors.LockedByOther, match="/base"):
            move(0.08)
        success, said = base.set_bool("/rosie/hand/lock", False)
        assert success, said
        move(0.08)
        screen.hear("heard", topic="/width", data=0.08)
