"""The programs of docs/guide.md, run as they stand there; what the page says of them holds."""

import sys
import threading
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
from msgspec import Struct

import trade
from tests.docs.blocks import DOCS, of, said, sections
from tests.docs.conftest import Play, Said
from tests.support.waiting import wait_until
from tests.system.conftest import Program
from trade import Handle, Settings, StateEvent, service, where
from trade.errors import Cancelled, CannotStart, DeviceFault, InvalidArgument
from trade.transport.endpoints import free_endpoint
from trade_drivers.testing import FakeJointGroup
from trade_gateway.stubs import write_stubs

PAGE = "guide.md"


def test_every_program_of_the_guide_is_run() -> None:
    assert sections(iter([DOCS / PAGE]), "python") == said(globals())


class Oven:
    def __init__(self) -> None:
        self.heated: list[tuple[float, float]] = []
        self.stopped = 0

    @service(cancel="stop")
    def heat(self, celsius: float, minutes: float = 10) -> float:
        self.heated.append((celsius, minutes))
        return celsius

    @service(effect="stop")
    def stop(self) -> None:
        self.stopped += 1


class Timer:
    def __init__(self) -> None:
        self.minutes: list[float] = []

    @service
    def set(self, minutes: float) -> None:
        self.minutes.append(minutes)


class Eye:
    @service
    def look(self, angle_rad: float) -> float:
        return angle_rad


@of(PAGE, "Offer services")
def test_offer_services(play: Play) -> None:
    play.run()
    for group in ("kitchen", "kitchen.oven", "hot"):
        assert {one.name for one in trade.services(where(group=group))} == {"temperature", "heat", "stop"}
    with pytest.raises(InvalidArgument, match="<= 250"):
        trade.call(where(name="heat"), 300)


class Head:
    """Its first call is reported; a faulty one refuses them all."""

    def __init__(self, fault: str = "") -> None:
        self.called = threading.Event()
        self._fault = fault

    @service
    def move_to(self, positions_rad: list[float]) -> list[float]:
        self.called.set()
        if self._fault:
            raise DeviceFault(device="rosie.neck.pan", bus="/dev/ttyUSB0", fault=self._fault)
        return positions_rad


@of(PAGE, "Find and call")
def test_find_and_call(play: Play, printed: Said) -> None:
    oven = Oven()
    play.offer("kitchen", oven, "kitchen.oven")
    play.run_next()
    assert oven.heated == [(180, 10), (180, 5), (180, 10), (180, 10)]
    assert "kitchen.oven.heat heat(celsius: float, minutes: float = 10) -> float" in printed.text


@of(PAGE, "Plan with conditions")
def test_plan_with_conditions(play: Play, printed: Said) -> None:
    play.run()
    assert "rosie.hand.pick_up ('see(?thing)', 'at(?place)')\n" in printed.text
    assert "(define (domain rosie)" in printed.text
    assert ":effect (and (holding ?thing) (not (empty hand)))" in printed.text


class Hand:
    def __init__(self) -> None:
        self.closed = threading.Event()

    @service
    def close(self) -> None:
        self.closed.set()


class Pan:
    @service(effect="read")
    def limits(self) -> list[float]:
        return [-1.4, 1.4]


@of(PAGE, "Robots as objects")
def test_robots_as_objects(play: Play, printed: Said) -> None:
    head, hand = FakeJointGroup(["rosie.neck.pan", "rosie.neck.tilt"]), Hand()
    for provider, group in ((head, "rosie.head"), (hand, "rosie.hand"), (Pan(), "rosie.neck.pan")):
        play.offer("rosie", provider, group)
    play.run()
    assert head.went == [[0.3, -0.2]] * 2
    assert hand.closed.wait(20)
    assert "[-1.4, 1.4]" in printed.text
    assert play.module.positions_rad == [0.3, -0.2]


@of(PAGE, "Types of a running robot")
def test_types_of_a_running_robot(play: Play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    head = FakeJointGroup(["rosie.neck.pan", "rosie.neck.tilt"])
    play.offer("rosie", head, "rosie.head")
    (tmp_path / "rosie_types.py").write_text(write_stubs(trade.services("rosie"), "rosie", "guide"))
    try:
        play.run()
    finally:
        sys.modules.pop("rosie_types", None)
    assert head.went == [[0.3, -0.2]] * 2
    assert play.module.positions_rad == [0.3, -0.2]


@pytest.mark.realtime
@of(PAGE, "Handles")
def test_handles(play: Play, printed: Said) -> None:
    for loop in ("find", "lock"):
        head = Head()

        def restart(loop: str = loop, head: Head = head) -> None:
            play.container(f"{loop}-1").register(head, "rosie.head")
            assert head.called.wait(60)
            play.container(f"{loop}-1").close()
            play.container(f"{loop}-2").register(Head("overload"), "rosie.head")

        restarting = threading.Thread(target=restart)
        restarting.start()
        with pytest.raises(DeviceFault, match="overload"):
            play.run_next()
        restarting.join()
        play.container(f"{loop}-2").close()
    assert "overload" in printed.text


@of(PAGE, "Call several services")
def test_call_many(play: Play, printed: Said) -> None:
    oven, timer = Oven(), Timer()
    play.offer("kitchen", oven, "kitchen.oven")
    play.offer("kitchen", timer, "kitchen.timer")
    play.run(heat=trade.find(where(name="heat")), timer=trade.find(where(name="set")))
    assert (oven.heated, oven.stopped, timer.minutes) == ([(180, 10), (180, 10)], 1, [5])
    assert [line.rpartition(" ")[2] for line in printed.lines] == ["180.0", "None"]


@of(PAGE, "Change a registered provider")
def test_change_what_is_offered(play: Play) -> None:
    play.run(arm=Eye())
    [look] = trade.services(where(group="rosie.left") & where(group="lab.bench"))
    assert look.meta == {"payload_kg": 1}
    assert look.health == "degraded: overheating"


@of(PAGE, "Long calls")
def test_long_calls(play: Play) -> None:
    play.run()
    trade.register(play.module.Painter(), "house")
    paint = trade.find(where(name="paint"))
    run = paint.start(["north", "south"])
    assert run.result() == 2
    assert run.progress()["wall"] in ("north", "south")
    run = paint.with_(deadline_s=600).start(["wall"] * 1000)
    wait_until(lambda: run.progress() is not None)
    run.cancel()
    with pytest.raises(Cancelled):
        run.result()


class Listener:
    """What it receives."""

    def __init__(self) -> None:
        self.reported: list[Any] = []

    @service
    def consult(self, knowledge: Handle) -> None:
        self.reported.append(knowledge.name)

    @service
    def dock(self, speed: float = 0.5) -> None:
        self.reported.append(speed)

    @service(effect="read")
    def is_low(self) -> bool:
        return True

    @service(effect="read")
    def battery(self) -> int:
        return 15


class Knowledge:
    @service(effect="read")
    def get_kb_name(self) -> str:
        return "cups"


@of(PAGE, "Notifications")
def test_notifications_arrive_for_services_health_and_time(play: Play, printed: Said) -> None:
    listener, eye = Listener(), Eye()
    play.offer("library", Knowledge(), "library")
    play.offer("mind", listener, "mind")
    play.offer("robot", eye, "rosie.head")
    play.run_next(consult=trade.find(where(name="consult")))
    wait_until(lambda: listener.reported == ["get_kb_name"])
    play.container("robot").set_health(eye, "degraded")
    wait_until(lambda: "is degraded" in printed.text)
    play.container("robot").close()
    wait_until(lambda: "gone:" in printed.text)
    listener.reported.clear()
    play.run()
    wait_until(lambda: 0.5 in listener.reported)  # once; the others come later than this ends
    occasions = [info.occasion for info in trade.notifications()]
    assert [next(one for one in occasions if one.startswith(word)) for word in ("every", "after", "at")]


@of(PAGE, "Hooks")
def test_watch_calls(play: Play, printed: Said) -> None:
    play.offer("mind", Eye(), "mind")
    play.run()
    assert trade.hooks() == []
    again = trade.after_service(where(group="mind"), call=play.module.add)
    trade.call(where(name="look"), 0.3)
    assert "<Handle mind.look in mind> {'angle_rad': 0.3} 0.3" in printed.text
    again.detach()


@of(PAGE, "Guards")
def test_refuse_calls(play: Play, printed: Said) -> None:
    play.run()
    assert "press.press was refused by its guard door_closed: the door is open" in printed.text
    assert "20.0 1" in printed.text
    assert trade.guards() == []


class JointNow(Struct, frozen=True):
    position_rad: float
    moving: bool


class Joints:
    """Two looks later they are at rest."""

    def __init__(self) -> None:
        self.looks = 0

    @service(effect="read")
    def state(self) -> list[JointNow]:
        self.looks += 1
        return [JointNow(0.1 * self.looks, self.looks < 3)]


@of(PAGE, "Streams")
def test_listen(play: Play, printed: Said) -> None:
    listener = Listener()
    play.offer("robot", Joints(), "rosie.head")
    play.offer("mind", listener, "mind")
    play.run(battery=trade.find(where(name="battery")), dock=trade.find(where(name="dock")))
    assert "moving=False" in printed.lines[-1]
    wait_until(lambda: listener.reported == [15, 15])  # of the stream, and of the existing one
    play.offer("mind-2", Listener(), "mind")
    wait_until(lambda: listener.reported == [15, 15, 15])


class MovingHead(Head, Joints):
    """Moves, and reports its joints."""

    def __init__(self) -> None:
        Head.__init__(self)
        Joints.__init__(self)


@of(PAGE, "From asyncio")
def test_from_asyncio(play: Play, printed: Said) -> None:
    head = MovingHead()
    play.offer("robot", head, "rosie.head")
    play.run()
    assert printed.lines == ["[0.3, -0.2]"]
    assert head.looks >= 3


@of(PAGE, "Locks, stops, e-stop")
def test_locks_and_stops(play: Play, printed: Said) -> None:
    expected = [line.rpartition("# ")[2] for block in play.left for line in block.text.splitlines() if "print(" in line]
    play.run()
    assert printed.lines == expected


@of(PAGE, "Observe a system")
def test_see_what_happens(play: Play) -> None:
    play.offer("robot", Eye(), "rosie.eye")
    play.run()
    assert play.module.span.service == "rosie.eye.look"
    assert play.module.tree.service == "rosie.eye.look"


class Searching:
    @service
    def search(self, event: StateEvent) -> None: ...


@of(PAGE, "States of containers")
def test_states_of_containers(play: Play) -> None:
    play.offer("base", Searching(), "planner")
    play.run()
    listed = {info.occasion.partition(" ")[0]: info.container for info in trade.notifications()}
    here = trade.container().name
    assert listed == {"hook_suspended": here, "call_deviated": here, "unlinked": "base"}


@of(PAGE, "While it runs")
def test_while_it_runs(play: Play) -> None:
    at = free_endpoint()
    with trade.Container(Settings.read(container="robot", listen=[at], connect=[at])):
        play.run(with_={"tcp/robot.example:7450": at})
        wait_until(lambda: "robot" in {info.name for info in trade.system.containers()})


@pytest.mark.realtime
@of(PAGE, "Create objects in other containers")
def test_objects_made_elsewhere(play: Play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mypkg").mkdir()
    (tmp_path / "mypkg" / "__init__.py").touch()
    (tmp_path / "mypkg" / "vision.py").write_text(
        dedent("""
        from trade import service
        class Camera:
            def __init__(self, width: int) -> None:
                self.width = width
            @service(effect="read")
            def shot(self) -> int:
                return self.width
            @service
            def zoom(self, times: float) -> None: ...
        """)
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    program = Program("-m", "trade_gateway", "container", "--name", "eyes", "--allow", "mypkg.vision:*", "--json")
    try:
        program.json()
        trade.find(where(name="instantiate", container="eyes"), wait_s=60)
        play.run()
        assert program.wait() == 0
    finally:
        program.close()


@pytest.mark.realtime
@of(PAGE, "Other hosts")
def test_other_hosts(play: Play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no other host: what stands for ``ssh`` says so. tests/system/test_starts.py has one."""
    ssh = tmp_path / "ssh"
    ssh.write_text('#!/bin/sh\necho "$@" > asked\necho "ssh: Could not resolve hostname robot.example" >&2\nexit 255\n')
    ssh.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    with pytest.raises(CannotStart, match="unknown host"):
        play.run()
    asked = (tmp_path / "asked").read_text()
    assert all(word in asked for word in ("robot.example", "--name eyes", "mypkg.vision:*", "tls/10.0.1.1:7450"))


MIND = """
from trade import service

class Planner:
    def __init__(self):
        self.plans = 0
    @service
    def plan(self) -> int:
        self.plans += 1
        return self.plans
    def save_state(self):
        return {"plans": self.plans}
    def restore_state(self, state):
        self.plans = state["plans"]
"""


@of(PAGE, "Migrate providers")
def test_providers_that_move(play: Play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start_container: Any) -> None:
    (tmp_path / "mind_that_moves.py").write_text(MIND)
    monkeypatch.syspath_prepend(tmp_path)
    import mind_that_moves  # pyright: ignore[reportMissingImports]

    monkeypatch.delitem(sys.modules, "mind_that_moves")  # at the end
    sys.modules["mind_that_moves"] = mind_that_moves
    start_container("spare", instantiable=["mind_that_moves:*"])
    wait_until(lambda: any(info.name == "spare" for info in trade.system.containers()))
    [plan] = trade.register(mind_that_moves.Planner(), "rosie.planner")
    assert plan() == 1
    play.run_next()
    assert play.module.plan.container == "spare"
    assert play.module.state == {"plans": 1}
    assert play.module.plan() == 2
    play.run()
    assert play.module.Planner.state_version == 2


@of(PAGE, "Load")
def test_how_busy_it_is(play: Play) -> None:
    play.container("arm")
    play.run()
