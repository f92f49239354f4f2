"""Services of either side, called by the other; parameters."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.support.ros1_system import Stand, our_node
from tests.support.waiting import PATIENCE_S, wait_until
from trade.errors import ConfigurationError
from trade_gateway.ros._graph import RosRefused, RosUnreachable
from trade_gateway.ros.ros1 import Ros1, _link, _service
from trade_gateway.ros.ros1._service import Served
from trade_gateway.ros_messages._types import Message, Types

pytestmark = pytest.mark.realtime

TRIGGER = "std_srvs/srv/Trigger"
SET_BOOL = "std_srvs/srv/SetBool"


def test_a_ros_service_is_called(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("gripper")
    peer.do("serve", "/close", "std_srvs/SetBool")
    peer.wait_for("did")
    assert graph.call("/close", SET_BOOL, {"data": True}, 30) == {"success": True, "message": "/trade asked True"}


def test_the_error_of_a_ros_service_is_reported(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("gripper")
    peer.do("serve", "/close", "std_srvs/Trigger", "fail")
    peer.wait_for("did")
    with pytest.raises(RosRefused, match="it is stuck"):
        graph.call("/close", TRIGGER, {}, 30)


def test_a_service_of_another_type_is_refused(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("gripper")
    peer.do("serve", "/close", "std_srvs/Trigger")
    peer.wait_for("did")
    with pytest.raises(RosRefused, match="md5sum"):
        graph.call("/close", SET_BOOL, {"data": True}, 30)


def test_a_service_without_a_server_is_unreachable(graph: Ros1) -> None:
    with pytest.raises(RosUnreachable, match="/close: no node offers it"):
        graph.call("/close", TRIGGER, {}, 30)


def test_a_service_whose_node_was_killed_is_unreachable(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("gripper")
    peer.do("serve", "/close", "std_srvs/Trigger")
    peer.wait_for("did")
    peer.end()
    with pytest.raises(RosUnreachable):
        graph.call("/close", TRIGGER, {}, 30)


def test_a_service_that_never_answers_is_given_up_and_others_are_not_held_up(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("gripper")
    peer.do("serve", "/hang", "std_srvs/Trigger", "hang")
    peer.do("serve", "/close", "std_srvs/Trigger")
    wait_until(lambda: len(peer.all("did")) == 2)
    failures: list[Exception] = []
    threads = our_node().num_threads()

    def hang() -> None:
        try:
            graph.call("/hang", TRIGGER, {}, 1)
        except RosUnreachable as error:
            failures.append(error)

    callers = [threading.Thread(target=hang) for _ in range(40)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(60)
    assert len(failures) == 40
    wait_until(lambda: our_node().num_threads() < threads + 10, "our node waits no more, either")
    assert any("no answer within" in str(failure) for failure in failures)
    assert graph.call("/close", TRIGGER, {}, 30)["success"]


def test_a_node_calls_our_service(graph: Ros1, stand: Stand) -> None:
    graph.serve("/lights", SET_BOOL, lambda request, who, at: {"success": request["data"], "message": f"for {who}"})
    peer = stand.peer("caller")
    peer.do("call", "/lights", "std_srvs/SetBool", {"data": True})
    assert peer.wait_for("called") == {"success": True, "message": "for /caller"}


def test_a_node_receives_the_error_of_our_service(graph: Ros1, stand: Stand) -> None:
    def fail(request: Message, who: str, at: float) -> Message:
        raise RuntimeError("the bulb is gone")

    graph.serve("/lights", TRIGGER, fail)
    peer = stand.peer("caller")
    peer.do("call", "/lights", "std_srvs/Trigger", {})
    assert "the bulb is gone" in peer.wait_for("failed")


def test_requests_are_answered_in_order_and_fail_when_the_service_is_withdrawn(graph: Ros1, stand: Stand) -> None:
    begun, go_on = threading.Semaphore(0), threading.Event()

    def slow(request: Message, who: str, at: float) -> Message:
        begun.release()
        assert go_on.wait(60)
        return {"success": True}

    served = graph.serve("/lights", TRIGGER, slow)
    peer = stand.peer("caller")
    for _ in range(2):
        peer.do("call", "/lights", "std_srvs/Trigger", {})
    assert begun.acquire(timeout=60)
    assert not begun.acquire(timeout=0.2)
    served.close()
    served.close()
    wait_until(lambda: len(peer.all("failed")) == 2, "both callers got an error")
    go_on.set()
    wait_until(lambda: is_forgotten(graph), "the master forgot it")


class HeldUp:
    """A service without ROS around it; the first request holds it up until `go_on`."""

    def __init__(self, *, stops: bool) -> None:
        self.go_on = threading.Event()
        self.begun: list[str] = []
        self.replies: dict[int, str] = {}
        self.served = Served(Types(1), "/lights", TRIGGER, self._answer, self._reply, stops=stops)

    def came(self, asked: int, *, ago_s: float = 0.0) -> None:
        self.served.came({"ask": asked, "who": f"/{asked}", "at": time.monotonic() - ago_s}, b"")

    def _answer(self, request: Message, who: str, at: float) -> Message:
        self.begun.append(who)
        assert self.go_on.wait(PATIENCE_S)
        return {"success": True}

    def _reply(self, asked: int, body: bytes, problem: str) -> None:
        self.replies[asked] = problem


def test_a_request_that_waited_long_for_its_turn_is_refused() -> None:
    made = HeldUp(stops=False)
    made.came(1)
    wait_until(lambda: made.begun, "the first is being answered")
    made.came(2, ago_s=_service._LATE_S + 1)
    made.came(3)
    made.go_on.set()
    wait_until(lambda: len(made.replies) == 3, "all got a reply")
    made.served.close()
    assert made.begun == ["/1", "/3"]
    assert made.replies[1] == made.replies[3] == ""
    assert "not executed" in made.replies[2]


def test_a_request_that_stops_waits_for_no_other_and_is_refused_for_nothing() -> None:
    made = HeldUp(stops=True)
    own = _service._AT_ONCE
    for asked in range(own + 40):
        made.came(asked, ago_s=60)
    wait_until(lambda: len(made.begun) == own + 1, "each has a thread, and one of the others its turn")
    assert {int(who[1:]) for who in made.begun} == set(range(own + 1))
    made.go_on.set()
    wait_until(lambda: len(made.replies) == own + 40, "all got a reply")
    made.served.close()
    assert set(made.replies.values()) == {""}
    in_order = [who for who in made.begun if int(who[1:]) >= own]
    assert in_order == [f"/{asked}" for asked in range(own, own + 40)]


def test_a_service_that_stops_is_called_however_many_other_calls_are_under_way(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("gripper")
    peer.do("serve", "/hang", "std_srvs/Trigger", "hang")
    wait_until(lambda: peer.all("did"), "it is offered")
    stopped: list[str] = []

    def stop(request: Message, who: str, at: float) -> Message:
        stopped.append(who)
        return {"success": True}

    graph.serve("/stop", TRIGGER, stop, stops=True)
    wait_until(lambda: is_answered(graph), "it is found")
    pool = ThreadPoolExecutor(_link._AT_ONCE)
    calls = [pool.submit(graph.call, "/hang", TRIGGER, {}, PATIENCE_S) for _ in range(_link._AT_ONCE)]
    wait_until(lambda: len(graph._link._pending_answers) == _link._AT_ONCE, "all turns are taken")
    with pytest.raises(RosUnreachable, match="other requests are pending"):
        graph.call("/stop", TRIGGER, {}, 0.1)
    assert graph.call("/stop", TRIGGER, {}, PATIENCE_S, stops=True)["success"]
    assert not any(call.done() for call in calls)
    peer.end()
    pool.shutdown()


def is_answered(graph: Ros1) -> bool:
    try:
        return graph.call("/stop", TRIGGER, {}, PATIENCE_S)["success"]
    except RosUnreachable:
        return False


def is_forgotten(graph: Ros1) -> bool:
    try:
        graph.call("/lights", TRIGGER, {}, PATIENCE_S)
    except RosRefused:
        return False
    except RosUnreachable:
        return True
    return False


def test_a_service_is_offered_once(graph: Ros1) -> None:
    graph.serve("/lights", TRIGGER, lambda request, who, at: {}).close()
    graph.serve("/lights", TRIGGER, lambda request, who, at: {})
    with pytest.raises(ConfigurationError, match="is offered already"):
        graph.serve("/lights", TRIGGER, lambda request, who, at: {})


def test_parameters_of_a_namespace_are_read_and_set(graph: Ros1) -> None:
    graph.set_parameter("/arm", "limits/speed", 0.5, 30)
    graph.set_parameter("/arm", "joints", ["pan", "tilt"], 30)
    graph.set_parameter("/arm", "enabled", True, 30)
    assert graph.parameters("/arm", 30) == {"limits/speed": 0.5, "joints": ["pan", "tilt"], "enabled": True}


def test_a_namespace_without_parameters_is_refused(graph: Ros1) -> None:
    with pytest.raises(RosRefused, match="/leg"):
        graph.parameters("/leg", 30)


def test_a_value_that_ros_cannot_express_is_refused(graph: Ros1) -> None:
    for value in (None, 2**40, [None], object()):
        with pytest.raises(RosRefused, match="/arm/x"):
            graph.set_parameter("/arm", "x", value, 30)
