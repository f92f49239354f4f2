"""From a fault on the wire to the log: who notices, what was measured before, and what a fault costs the bus thread."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import pytest

import trade_hil_sim as sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig
from tests.unit.drivers.gripper_rig import HandRig
from trade import Container, where
from trade.errors import ConfigurationError, DeviceSilent
from trade_drivers import AttachedRobot, Camera, FaultInfo, FaultLog, Motor, MotorState, Reading, Sensor
from trade_drivers.faults import FaultPoller

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[HandRig]:
    with ExitStack() as undo:
        rig = HandRig(tmp_path, undo)
        rig.plug()
        yield rig


def opened(robot: AttachedRobot) -> dict[tuple[str, str], FaultInfo]:
    return {(info.device, info.kind): info for info in robot.faults.faults(open_only=True)}


def await_fault(robot: AttachedRobot, device: str, kind: str) -> FaultInfo:
    wait_until(lambda: (device, kind) in opened(robot), f"{device} has {kind!r}")
    return opened(robot)[device, kind]


def await_none(robot: AttachedRobot) -> None:
    wait_until(lambda: not opened(robot), "nothing is wrong any more")


def test_a_fault_in_a_move_is_noted_with_what_was_measured_on_the_way(head: Rig) -> None:
    robot = head.attach()
    pan = robot.motor("neck.pan")
    moving = Outcome(lambda: pan.move_to(1.3, 0.5))
    wait_until(lambda: head.truth(1).position_rad > 0.4, "it is under way")
    head.sim.do(sim.HardwareFault(ids=(1,)))
    assert moving.wait().error is not None
    info = await_fault(robot, "rosie.neck.pan", "hardware error: overload")
    assert info.text == "rosie.neck.pan: hardware error: overload"
    assert "enable()" in info.remedy
    fault = robot.faults.fault(info.id)
    way = [sample.values["position_rad"] for sample in fault.first]
    assert way == sorted(way)
    assert way[-1] - way[0] > 0.1
    assert max(sample.values["velocity_rad_s"] for sample in fault.first) > 0.2
    assert all(sample.values["voltage_v"] > 0 for sample in fault.first)
    times = [sample.s for sample in fault.first]
    assert times == sorted(times)
    assert len(times) <= 50

    wait_until(lambda: not head.truth(1).moving, "it rests")
    head.sim.do(sim.Heal())
    pan.enable()
    await_none(robot)
    [gone] = robot.faults.faults()
    assert (gone.id, gone.open, gone.count) == (info.id, False, 1)
    assert gone.lasted_s > 0


def test_two_faults_of_one_joint_and_its_silence_are_three(head: Rig) -> None:
    robot = head.attach()
    head.sim.do(sim.HardwareFault(ids=(1,), bits=0x20))
    await_fault(robot, "rosie.neck.pan", "hardware error: overload")
    head.sim.do(sim.HardwareFault(ids=(1,), bits=0x24))
    hot = await_fault(robot, "rosie.neck.pan", "hardware error: overheating")
    head.sim.do(sim.Mute(ids=(1,)))
    silent = await_fault(robot, "rosie.neck.pan", "silent")
    assert "rosie.neck.pan did not answer" in silent.text
    kinds = {"hardware error: overload", "hardware error: overheating", "silent"}
    assert set(opened(robot)) == {("rosie.neck.pan", kind) for kind in kinds}
    assert robot.faults.health("rosie.neck.pan") == "silent"
    assert not robot.faults.health("rosie.neck.tilt")
    head.sim.do(sim.Heal())
    wait_until(lambda: ("rosie.neck.pan", "silent") not in opened(robot), "it is heard again")
    assert opened(robot)["rosie.neck.pan", hot.kind].count == 1


def test_a_bus_that_is_unplugged_is_one_fault_of_each_device_until_it_is_heard(head: Rig) -> None:
    robot = head.attach()
    for turn in (1, 2):
        head.sim.do(sim.Unplug())
        for joint in ("rosie.neck.pan", "rosie.neck.tilt"):
            assert await_fault(robot, joint, "bus gone").count == turn
        head.sim.do(sim.Replug())
        await_none(robot)
    assert {info.kind for info in robot.faults.faults()} == {"bus gone"}


def test_a_thread_of_a_bus_that_fails_is_a_fault_of_its_devices(head: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = head.attach()
    thread: Any = robot._buses["neck"]
    monkeypatch.setattr(thread._thread.exchange, "cycle", lambda: 1 / 0)
    info = await_fault(robot, "rosie.neck.tilt", "the thread of its bus failed: ZeroDivisionError('division by zero')")
    assert info.open


def test_an_observer_that_fails_ends_no_motion(
    head: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    robot = head.attach()
    thread: Any = robot._buses["neck"]
    monkeypatch.setattr(thread._thread._lookout, "look", lambda: 1 / 0)
    wait_until(lambda: "are no longer reported" in caplog.text, "that is said")
    assert robot.motor("neck.pan").move_to(0.3) == pytest.approx(0.3, abs=0.03)


def test_a_fault_during_shutdown_is_recorded_for_the_next_process(head: Rig, tmp_path: Path) -> None:
    robot = head.attach(state_dir=tmp_path)
    bus: Any = robot._buses["neck"]
    leave = bus._thread.exchange.leave

    def leave_and_break(*about: Any, **more: Any) -> None:
        leave(*about, **more)
        bus._axes["neck.tilt"].fault = "it broke at the last moment"

    bus._thread.exchange.leave = leave_and_break
    robot.close()
    again = head.attach(state_dir=tmp_path)
    [info] = again.faults.faults()
    assert (info.device, info.kind) == ("rosie.neck.tilt", "it broke at the last moment")
    assert not info.open


def test_a_fault_that_is_still_there_at_the_next_attach_is_the_same_and_one_that_is_not_is_gone(
    head: Rig, tmp_path: Path
) -> None:
    robot = head.attach(state_dir=tmp_path)
    head.sim.do(sim.HardwareFault(ids=(1,)))
    pan = await_fault(robot, "rosie.neck.pan", "hardware error: overload")
    head.sim.do(sim.HardwareFault(ids=(2,)))
    tilt = await_fault(robot, "rosie.neck.tilt", "hardware error: overload")
    robot.faults.acknowledge(pan.id)
    robot.close()
    head.sim.do(sim.Heal())
    head.sim.do(sim.BrownOut(ids=(2,)))
    again = head.attach(state_dir=tmp_path)
    still = await_fault(again, "rosie.neck.pan", "hardware error: overload")
    assert (still.id, still.count, still.first_at, still.acknowledged_by) == (
        pan.id,
        1,
        pan.first_at,
        "its own process",
    )
    [gone] = [info for info in again.faults.faults() if info.id == tilt.id]
    assert not gone.open


def test_a_gripper_reports_its_faults(hand: HandRig) -> None:
    robot = hand.attach()
    robot.gripper("left.hand").activate()
    hand.sim.do(sim.HardwareFault(bits=14))
    wait_until(lambda: robot.gripper("left.hand").state().fault, "it has a fault")
    info = await_fault(robot, "rosie.left.hand", robot.gripper("left.hand").state().fault)
    assert {"width_m", "current_a", "force_n"} <= set(robot.faults.fault(info.id).latest[-1].values)


def test_faults_are_services_for_any_client_and_an_acknowledgement_names_the_client(
    head: Rig, start_container: Callable[..., Container]
) -> None:
    driver, asker = start_container("driver"), start_container("asker")
    robot = head.attach(register=driver.register, deregister=driver.deregister, set_health=driver.set_health)
    head.sim.do(sim.HardwareFault(ids=(1,)))
    info = await_fault(robot, "rosie.neck.pan", "hardware error: overload")

    def ask(name: str) -> Any:
        return asker.find(where(name=name, group="rosie.faults"), wait_s=20)

    assert [each.id for each in ask("faults")(open_only=True)] == [info.id]
    assert ask("fault")(info.id).first
    with driver.lock(where(group="rosie"), wait_s=10) as lock:
        assert lock.resources == ("rosie.neck.pan", "rosie.neck.tilt")
        assert ask("acknowledge")(info.id).acknowledged_by == asker.address.identity
    with asker.open_session("anna") as session, session.use():
        assert ask("acknowledge")(info.id).acknowledged_by == f"{asker.address.identity} for anna"

    def healths() -> set[tuple[str, str]]:
        found = asker.services(where(name="state", group="rosie"))
        return {(handle.groups[0], handle.record.health) for handle in found}

    wrong = "hardware error: overload"
    wanted = {
        ("rosie.neck.pan", f"degraded: {wrong}"),
        ("rosie.head", f"degraded: rosie.neck.pan: {wrong}"),
        ("rosie.neck.tilt", "healthy"),
    }
    wait_until(lambda: healths() == wanted, "the registry says so")


def test_to_look_costs_the_bus_thread_a_small_part_of_its_cycle(head: Rig) -> None:
    robot = head.attach()
    bus: Any = robot._buses["neck"]
    thread = bus._thread
    cycle, look = thread.exchange.cycle, thread._lookout.look
    spent = {"cycle": 0, "look": 0}

    def timed(name: str, act: Callable[[], None]) -> Callable[[], None]:
        def measured() -> None:
            began = time.thread_time_ns()
            act()
            spent[name] += time.thread_time_ns() - began

        return measured

    before = thread.cycles
    thread.exchange.cycle, thread._lookout.look = timed("cycle", cycle), timed("look", look)
    wait_until(lambda: thread.cycles - before > 150, "it has cycled")
    assert 0 < spent["look"] < 0.2 * spent["cycle"], spent


def asked(log: FaultLog, name: str, device: object) -> FaultPoller:
    recorder = FaultPoller(log, "faults of a test")
    recorder.start({name: device}, {name})
    return recorder


def test_a_device_of_another_driver_is_asked_and_its_mistakes_are_faults_too() -> None:
    motor, log = create_autospec(Motor, instance=True), FaultLog("rosie")
    motor.state.return_value = None
    silent = DeviceSilent(device="rosie.pan", bus="/dev/ttyUSB0", waited_s=0.3)
    well: dict[str, Any] = dict.fromkeys(("position_rad", "velocity_rad_s", "load", "measured_at", "age_s"), 0.0)
    well |= {"name": "rosie.pan", "temperature_c": None, "voltage_v": None, "enabled": True, "moving": False}
    recorder = asked(log, "rosie.pan", motor)
    try:
        wait_until(lambda: log.health("rosie.pan") == "TypeError", "what is no state is a mistake")
        for answer, kind in (
            (MotorState(**well), ""),
            (MotorState(**well, fault="overload"), "overload"),
            (silent, "silent"),
            (ZeroDivisionError("oops"), "ZeroDivisionError"),
            (MotorState(**well), ""),
        ):
            motor.state.side_effect = [answer] * 10_000
            wait_until(lambda kind=kind: log.health("rosie.pan") == kind, f"it is {kind!r}")
    finally:
        recorder.close()
    reported = {info.kind: (info.text, info.open) for info in log.faults()}
    assert reported == {
        "overload": ("rosie.pan: overload", False),
        "silent": (str(silent), False),
        "TypeError": (
            "rosie.pan: its state cannot be read: TypeError('NoneType is not a state or a reading')",
            False,
        ),
        "ZeroDivisionError": ("rosie.pan: its state cannot be read: ZeroDivisionError('oops')", False),
    }


def test_a_sensor_is_silent_and_healthy_again_and_earlier_measurements_are_kept() -> None:
    sensor, log = create_autospec(Sensor, instance=True), FaultLog("rosie")
    silent = DeviceSilent(device="rosie.scale", bus="/dev/ttyUSB0", waited_s=1.2)
    sensor.read.return_value = Reading(name="rosie.scale", value=[1.0, 2.5], unit="kg", stamp_ns=1, age_s=0.0)
    recorder = asked(log, "rosie.scale", sensor)
    try:
        wait_until(lambda: sensor.read.call_count > 3, "it was read")
        sensor.read.side_effect = silent
        wait_until(lambda: log.health("rosie.scale") == "silent", "it is silent")
        sensor.read.side_effect = None
        sensor.read.return_value = Reading(name="rosie.scale", value=1.0, unit="kg", stamp_ns=10**9, age_s=0.0)
        wait_until(lambda: not log.health("rosie.scale"), "it is well")
    finally:
        recorder.close()
    [info] = log.faults()
    assert (info.text, info.count) == (str(silent), 1)
    assert log.fault(info.id).first[-1].values == {"value.0": 1.0, "value.1": 2.5}


def test_a_camera_is_not_asked_for_pictures_to_see_whether_it_is_healthy() -> None:
    camera, motor, log = (
        create_autospec(Camera, instance=True),
        create_autospec(Motor, instance=True),
        FaultLog("rosie"),
    )
    motor.state.side_effect = DeviceSilent(device="rosie.pan", bus="/dev/ttyUSB0", waited_s=0.3)
    recorder = FaultPoller(log, "faults of a test")
    recorder.start({"rosie.eye": camera, "rosie.pan": motor}, {"rosie.eye", "rosie.pan"})
    wait_until(lambda: log.health("rosie.pan") == "silent", "the others are asked")
    recorder.close()
    camera.image.assert_not_called()


def test_the_health_of_a_provider_is_reported_once_it_is_registered() -> None:
    provider, attempts, reported = object(), list[str](), list[str]()

    def set_health(_: object, health: str) -> None:
        attempts.append(health)
        if len(attempts) < 3:
            raise ConfigurationError(problem="it is not registered here")
        reported.append(health)

    poller = FaultPoller(FaultLog("rosie"), "faults of a test", set_health)
    poller.start({}, (), {provider: [lambda: "degraded: overheating"]})
    wait_until(lambda: reported, "it is reported")
    time.sleep(2.0)
    poller.close()
    assert (attempts, reported) == (["degraded: overheating"] * 3, ["degraded: overheating"])
