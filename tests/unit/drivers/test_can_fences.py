"""Locks, stops and time on a CAN bus, through containers; the judge is the frames the simulated drives received."""

from collections.abc import Callable

import pytest

import trade
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, call, sleep_past, written_now
from tests.unit.drivers.gate import Gate
from tests.unit.drivers.legs import COUNTS_PER_RAD, HALT, HIP, KNEE, PATIENT, Leg, rig
from trade import Container, Handle, where
from trade.errors import (
    DeadlineExceeded,
    DeviceFault,
    IncompleteGroup,
    LockedByOther,
    LockLost,
    MotionStopped,
    NotLocked,
    Stopped,
    TradeError,
)
from trade_drivers import AttachedRobot, Motor
from trade_hil_sim import Entry, Place, Replug, Unplug

__all__ = ["rig"]

SETTLED_S = 0.3
QUICK_STOP = 0x02
"""Of bits 1, 2 and 7 of the controlword only the first (CiA 402-2, device control commands)."""
HIP_SERVICES = where(group="rosie.leg.hip")


def commanded(leg: Leg, since: float = 0.0) -> list[Entry]:
    """Every frame that could set a drive moving: controlwords with targets, and writes of such objects."""
    orders = {b"\x40\x60", b"\x60\x60", b"\x7a\x60", b"\xff\x60"}
    asked = [e for e in leg.frames("sdo_request", since=since) if e.data[0] & 0xE0 == 0x20 and e.data[1:3] in orders]
    return leg.frames("rpdo1", since=since) + asked


def halts(frame: Entry) -> bool:
    """Whether this controlword brings a drive to rest: by a halt, or by a quick stop in the modes that have none."""
    word = int.from_bytes(frame.data[:2], "little")
    return bool(word & HALT) or word & 0x86 == QUICK_STOP


@pytest.fixture
def leg(rig: Leg) -> Leg:
    rig.configure(PATIENT)
    rig.plug()
    return rig


@pytest.fixture
def driver(start_container: Callable[..., Container]) -> Container:
    return start_container("driver")


@pytest.fixture
def robot(leg: Leg, gate: Gate, driver: Container) -> AttachedRobot:
    return leg.attach(register=driver.register, deregister=driver.deregister, healthy=gate)


@pytest.fixture
def hip(robot: AttachedRobot) -> Motor:
    return robot.motor("leg.hip")


@pytest.fixture
def planner(start_container: Callable[..., Container], robot: AttachedRobot) -> Container:
    return start_container("planner")


@pytest.fixture
def operator(start_container: Callable[..., Container], robot: AttachedRobot) -> Container:
    return start_container("operator")


def service(container: Container, name: str, group: str = "rosie.leg.hip") -> Handle:
    return container.find(where(name=name, group=group), wait_s=20).with_(deadline_s=60)


# --- S01


@pytest.mark.parametrize("command", ["move_to", "set_velocity", "enable", "relax"])
def test_S01_a_command_that_expires_while_the_bus_is_held_up_is_never_sent(
    leg: Leg, gate: Gate, hip: Motor, command: str
) -> None:
    if command != "enable":
        hip.enable()
    act: dict[str, Callable[[], object]] = {
        "move_to": lambda: hip.move_to(0.5),
        "set_velocity": lambda: hip.set_velocity(0.5, 0.05),
        "enable": hip.enable,
        "relax": hip.relax,
    }
    gate.hold_up()
    mark = written_now()
    late = Outcome(act[command], deadline_s=0.05)
    with call(0.05) as expires_ns:
        sleep_past(expires_ns)
    gate.let_go()
    assert isinstance(late.wait().error, DeadlineExceeded)
    assert not commanded(leg, mark)


def test_S01_a_search_for_home_that_does_not_end_in_time_is_halted_and_told_before_its_deadline(
    leg: Leg, hip: Motor, planner: Container
) -> None:
    hip.enable()
    with pytest.raises(DeviceFault, match="has not found its home in time"):
        service(planner, "home").with_(deadline_s=1.5)(34, 0.01)
    assert any(halts(e) for e in leg.frames("rpdo1", HIP, leg.wait_for("motion_started", HIP).t))


# --- S13


def test_S13_a_joint_that_comes_after_its_group_was_locked_is_sent_nothing_under_that_lock(
    leg: Leg, gate: Gate, driver: Container, start_container: Callable[..., Container]
) -> None:
    """A lock over a robot and a lamp, while the robot's driver is away."""

    class Lamp:
        @trade.service
        def light(self) -> None: ...

    planner, either = start_container("planner"), where(group="rosie.leg") | where(group="lamp")
    driver.register(Lamp(), "lamp")
    planner.find(where(group="lamp"), wait_s=20)
    with pytest.raises(IncompleteGroup, match=r"group='rosie\.leg' missing"):
        planner.lock(either, wait_s=0).acquire()
    with planner.lock(either, partial=True):
        leg.attach(register=driver.register, deregister=driver.deregister, healthy=gate)
        services = [(service(planner, name), args) for name, args in (("enable", ()), ("move_to", (0.3,)))]
        mark = written_now()
        for handle, args in services:
            with pytest.raises(NotLocked):
                handle(*args)
        assert not commanded(leg, mark)
        service(planner, "stop")()
    with planner.lock(either):
        assert services[1][0](0.1) == pytest.approx(0.1, abs=0.01)


# --- S05


def test_S05_a_motion_ends_with_its_session_whoever_else_used_the_joint_meanwhile(
    leg: Leg, hip: Motor, planner: Container, operator: Container
) -> None:
    service(planner, "move_to").start(0.9, 0.1)
    began = leg.wait_for("motion_started", HIP)
    service(operator, "enable")()  # disturbs nothing
    planner.close()
    rest = leg.wait_for("at_rest", HIP, began.t)
    assert any(halts(e) for e in leg.frames("rpdo1", HIP, began.t) if e.t <= rest.t)
    assert leg.truth(HIP).position_rad < 0.8


# --- S06


def test_S06_a_process_that_is_not_healthy_halts_its_drives_and_feeds_them_no_more(
    leg: Leg, gate: Gate, hip: Motor
) -> None:
    moving = Outcome(lambda: hip.move_to(0.9, 0.1))
    began = leg.wait_for("motion_started", HIP)
    gate.says = False
    assert moving.wait().error is not None
    rest = leg.wait_for("at_rest", HIP, began.t)
    expired = leg.wait_for("watchdog_expired", HIP)
    assert any(halts(e) for e in leg.frames("rpdo1", HIP, began.t) if e.t <= rest.t)
    wait_until(lambda: len(leg.frames("heartbeat", HIP, expired.t)) > 3, "the drive goes on")
    assert not [e for e in leg.frames(since=rest.t) if e.direction == "in"], "it is silent from then on"


# --- S08


def test_S08_a_stop_reaches_what_is_held_up_in_the_queue(
    leg: Leg, gate: Gate, hip: Motor, planner: Container, operator: Container
) -> None:
    hip.enable()
    gate.hold_up()
    mark = written_now()
    run = service(planner, "move_to").start(0.9)
    wait_until(lambda: hip._exchange._inbox, "the move is admitted")  # type: ignore[attr-defined]
    stop = service(operator, "stop").start()
    wait_until(lambda: hip._exchange._stops, "the stop is there")  # type: ignore[attr-defined]
    gate.let_go()
    stop.result()
    with pytest.raises(MotionStopped):
        run.result()
    assert not leg.goals(HIP, mark)
    assert not leg.events("motion_started", HIP, mark)


def test_S08_a_foreign_stop_holds_until_somebody_resumes(
    leg: Leg, hip: Motor, planner: Container, operator: Container
) -> None:
    move = service(planner, "move_to")
    run = move.start(0.9, 0.2)
    leg.wait_for("motion_started", HIP)
    service(operator, "stop")()
    with pytest.raises(MotionStopped):
        run.result()
    mark = written_now()
    for act in (lambda: move(0.9), service(operator, "enable"), lambda: hip.move_to(0.9)):
        with pytest.raises(Stopped):
            act()
    assert not leg.goals(HIP, mark)
    assert operator.locking.resume(HIP_SERVICES) == ["rosie.leg.hip"]
    assert move(0.1) == pytest.approx(0.1, abs=0.01)


# --- S11


def test_S11_a_command_admitted_under_a_lock_that_is_lost_never_reaches_the_wire(
    leg: Leg, gate: Gate, hip: Motor, planner: Container, operator: Container
) -> None:
    hip.enable()
    move = service(planner, "move_to")
    lock = planner.lock(HIP_SERVICES).acquire()
    with lock.use():
        gate.hold_up()
        mark = written_now()
        run = move.start(0.9)
        wait_until(lambda: hip._exchange._inbox, "the move is admitted")  # type: ignore[attr-defined]
        assert operator.locking.break_lock(HIP_SERVICES, "it is mine")
        gate.let_go()
        with pytest.raises((LockLost, MotionStopped)):
            run.result()
    lock.release()
    assert not leg.goals(HIP, mark)
    assert not leg.events("motion_started", HIP, mark)


def test_S11_a_set_point_ends_with_the_lock_it_was_admitted_under(leg: Leg, hip: Motor, planner: Container) -> None:
    turn = service(planner, "set_velocity")
    with planner.lock(HIP_SERVICES):
        turn(0.3, 1.0)
        began = leg.wait_for("motion_started", HIP)
    rest = leg.wait_for("at_rest", HIP, began.t)
    assert any(halts(e) for e in leg.frames("rpdo1", HIP, began.t) if e.t <= rest.t)
    assert leg.truth(HIP).position_rad < 0.3


def test_S11_who_has_no_lock_sends_nothing(leg: Leg, hip: Motor, planner: Container, operator: Container) -> None:
    hip.enable()
    with planner.lock(where(group="rosie.leg")):
        mark = written_now()
        for act in (
            lambda: service(operator, "move_to")(0.3),
            lambda: service(operator, "set_velocity")(0.3),
            service(operator, "enable"),
            service(operator, "relax"),
            service(operator, "home"),
            lambda: hip.move_to(0.3),  # a plain call of the method, without the middleware (S15)
        ):
            with pytest.raises(LockedByOther):
                act()
        assert service(operator, "state")().name == "rosie.leg.hip"
    assert not commanded(leg, mark)


# --- S18


def test_S18_enabling_aims_at_the_measured_position(leg: Leg, hip: Motor) -> None:
    leg.sim.do(Place(counts=3000, ids=(HIP,)))
    wait_until(lambda: hip.state().position_rad == pytest.approx(3000 / COUNTS_PER_RAD, abs=1e-4), "it is measured")
    mark = written_now()
    hip.enable()
    targets = {int.from_bytes(e.data[2:], "little", signed=True) for e in leg.frames("rpdo1", HIP, mark)}
    assert targets == {3000}
    assert not leg.goals(HIP, mark)
    assert not leg.events("motion_started", HIP, mark)


def test_S18_replugging_never_enables_and_never_commands(leg: Leg, robot: AttachedRobot, hip: Motor) -> None:
    hip.move_to(0.3)
    mark = written_now()
    leg.sim.do(Unplug())
    wait_until(lambda: not answers(hip), "the driver noticed")
    leg.sim.do(Replug())
    wait_until(lambda: answers(hip) and answers(robot.motor("leg.knee")), "the driver is back")
    back = written_now()
    wait_until(lambda: hip.state().measured_at > back + SETTLED_S, "it had time")
    with pytest.raises(DeviceFault, match="it was away"):
        hip.move_to(0.0)
    assert not commanded(leg, mark)
    assert not leg.events("motion_started", since=mark)
    assert not any(state.detail == "operation_enabled" for state in leg.events("state", KNEE))


def answers(motor: Motor) -> bool:
    try:
        motor.state()
    except TradeError:
        return False
    return True
