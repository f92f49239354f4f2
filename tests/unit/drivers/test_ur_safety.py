"""Safety of the arm driver, rule by rule; the judge is what the simulated controller received and did."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import psutil
import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.arm_rig import FAR, SLOW, ArmRig, answers, arm_rig, children, free_rig
from tests.unit.drivers.attached_arm import ARM, AT_HOME
from tests.unit.drivers.conftest import Outcome, call, sleep_past, written_now
from trade import Container, errors, where
from trade_drivers import Arm, Tolerances, Trajectory, TrajectoryPoint
from trade_hil_sim import Absent, Local, Mute, Unplug, events, instructions

pytestmark = pytest.mark.realtime

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
__all__ = ["arm_rig", "free_rig"]


def test_S01_a_command_whose_time_has_passed_is_never_sent(rig: ArmRig) -> None:
    with call(0.2) as expires_ns:
        sleep_past(expires_ns)
        with pytest.raises(errors.DeadlineExceeded):
            rig.arm.move_joints(FAR)
    assert not rig.moves()


def test_S01_what_waits_in_the_process_that_commands_expires_there(rig: ArmRig) -> None:
    rig.arm.move_joints([0.05, *AT_HOME[1:]])  # control is taken
    [pid] = children("control")
    os.kill(pid, signal.SIGSTOP)
    mark = written_now()
    late = Outcome(lambda: rig.arm.move_joints(FAR), deadline_s=0.1)
    sleep_past(int((mark + 0.15) * 1e9))
    os.kill(pid, signal.SIGCONT)
    assert isinstance(late.wait().error, errors.DeadlineExceeded | errors.MotionStopped | errors.DeviceFault)
    wait_until(lambda: answers(rig.arm, mark + 0.5), "time has passed")
    assert not rig.moves(mark)


def test_S04_a_set_point_that_is_not_renewed_ends_in_a_stop(rig: ArmRig) -> None:
    rig.arm.servo(FAR, 0.3)
    wait_until(lambda: rig.base_rad > 0.02, "it is under way")
    rig.comes_to_rest()
    last = rig.moves()[-1]
    wait_until(lambda: instructions(rig.log, "servo_stop", since=last.t), "the stream is ended")
    mark = written_now()
    wait_until(lambda: rig.arm.state().measured_at > mark + 0.1, "time has passed")
    assert not rig.moves(mark)


class Driver:
    """A driver in a process of its own that moves the arm."""

    def __init__(self, rig: ArmRig, folder: Path) -> None:
        file = folder / "arm.toml"
        file.write_text(ARM)
        program = Path(__file__).with_name("arm_process.py")
        self.process = subprocess.Popen([sys.executable, str(program), str(file), rig.sim.port, "servo"])

    def close(self) -> None:
        family = psutil.Process(self.process.pid).children()
        self.process.kill()
        self.process.wait()
        psutil.wait_procs(family, 20)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill -9", "SIGSTOP"])
def test_S06_without_its_driver_an_arm_that_follows_set_points_stops(free: ArmRig, tmp_path: Path, number: int) -> None:
    with ExitStack() as undo:
        driver = Driver(free, tmp_path)
        undo.callback(driver.close)
        wait_until(lambda: free.base_rad > 0.05, "it is under way")
        os.kill(driver.process.pid, number)
        mark = written_now()
        free.comes_to_rest()
        wait_until(lambda: events(free.log, "program_stopped", since=mark), "its program has ended")
        assert not free.moves(events(free.log, "program_stopped", since=mark)[0].t)


def test_S06_a_process_that_commands_and_is_killed_leaves_the_stop_to_the_watchdog_of_the_robot(rig: ArmRig) -> None:
    moving = rig.set_off()
    rig.sim.do(Local())  # its dashboard takes no orders
    [pid] = children("control")
    os.kill(pid, signal.SIGKILL)
    assert isinstance(moving.wait().error, errors.DeviceFault)
    rig.comes_to_rest()
    assert events(rig.log, "watchdog_expired")
    wait_until(lambda: children("control"), "there is a new one")
    mark = written_now()
    assert children("control") != [pid]
    rig.sim.do(Local(on=False))
    wait_until(lambda: rig.arm.state().measured_at > mark + 0.2, "time has passed")
    assert not rig.moves(mark)  # restarted, but not into motion
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("how", ["move_joints", "servo", "follow"])
def test_S06_an_arm_that_moved_when_its_host_was_suspended_does_not_continue(
    rig: ArmRig, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    joints = [limit.name for limit in rig.arm.limits().joints]
    ends = [TrajectoryPoint(time_from_start_s=s, positions_rad=[s * SLOW, *AT_HOME[1:]]) for s in (0.0, 8.0)]
    way = Trajectory(joints=joints, points=ends)
    acts: dict[str, Callable[[], object]] = {
        "move_joints": lambda: rig.arm.move_joints(FAR, SLOW),
        "servo": lambda: rig.arm.servo(FAR, 1.0),
        "follow": lambda: rig.arm.follow(way, Tolerances(path_rad=1.0)),
    }
    moving = Outcome(acts[how])
    wait_until(lambda: moving.error or rig.base_rad > 0.05, "it is under way")
    exchange = rig.arm._exchange  # type: ignore[attr-defined]
    clock, asleep = exchange.lasting_clock, written_now()
    monkeypatch.setattr(exchange, "lasting_clock", lambda: clock() + 3600 * 10**9)
    error = moving.wait().error
    rig.comes_to_rest()
    assert len(rig.moves(asleep)) < 20  # a set-point that continues for its second is sent more than a hundred times
    mark = written_now()
    if how != "servo":  # whose call was answered when it began
        assert isinstance(error, errors.DeviceFault)
        assert "held up for 3600." in str(error)
    wait_until(lambda: answers(rig.arm, mark + 0.3), "time has passed")
    assert not rig.moves(mark)


def test_S07_a_stop_is_the_first_thing_the_controller_hears_however_many_wait(rig: ArmRig) -> None:
    moving = rig.set_off()
    exchange = rig.arm._exchange  # type: ignore[attr-defined]
    released, reached, listen = threading.Event(), threading.Event(), exchange.listen

    def held_up() -> None:
        reached.set()
        released.wait(20)
        listen()

    exchange.listen = held_up
    assert reached.wait(20)
    mark = written_now()
    waiting = [Outcome(lambda: rig.arm.move_joints(FAR)) for _ in range(3)]
    wait_until(lambda: len(exchange._inbox) == 3, "they wait")
    stopping = Outcome(rig.arm.stop)
    wait_until(lambda: exchange._stops, "the stop has come")
    exchange.listen = listen
    released.set()
    assert all(one.wait().error is not None for one in (moving, *waiting))
    assert stopping.wait().error is None
    rig.comes_to_rest()
    assert not rig.moves(mark)


def test_S07_a_stop_and_the_state_are_answered_at_once_while_a_lost_controller_is_looked_for(rig: ArmRig) -> None:
    rig.arm.move_joints([0.05, *AT_HOME[1:]])  # control is taken
    [pid] = children("control")
    os.kill(pid, signal.SIGSTOP)  # it does not end by itself
    rig.sim.do(Unplug())
    wait_until(lambda: _is_gone(rig.arm), "it is noticed")
    for _ in range(20):
        with pytest.raises(errors.BusGone):
            rig.arm.state()
    with pytest.raises(errors.BusGone):
        rig.arm.stop()
    assert pid in children("control")  # no thread has waited for it


def test_S07_a_driver_is_closed_while_a_silent_controller_is_looked_for(
    rig: ArmRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade_drivers.vendors.ur._link._FIRST_S", 3600.0)
    rig.sim.do(Absent())
    wait_until(lambda: _is_gone(rig.arm), "it is noticed")
    wait_until(_freezes_who_looks, "there is a process that looks for it")
    with pytest.raises(errors.BusGone):
        rig.arm.stop()
    with suppress(errors.TradeError):
        rig.robot.close()
    assert not children("states")


def test_S10_a_stop_goes_through_the_dashboard_and_the_process_that_commands(rig: ArmRig) -> None:
    moving = rig.set_off()
    mark = written_now()
    rig.arm.stop()
    assert isinstance(moving.wait().error, errors.MotionStopped)
    assert not rig.moving
    assert [e for e in instructions(rig.log, "dashboard", since=mark) if e.detail.startswith("stop ->")]
    assert not rig.moves(mark)
    rig.comes_to_rest()


def test_S10_a_process_that_does_not_answer_a_stop_is_killed_and_the_arm_halts(rig: ArmRig) -> None:
    moving = rig.set_off()
    [pid] = children("control")
    os.kill(pid, signal.SIGSTOP)
    rig.arm.stop()
    assert isinstance(moving.wait().error, errors.MotionStopped)
    rig.comes_to_rest()
    wait_until(lambda: children("control") and children("control") != [pid], "it is killed and replaced")
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)


def test_S10_a_dashboard_that_does_not_answer_does_not_hinder_a_stop(rig: ArmRig) -> None:
    moving = rig.set_off()
    rig.sim.do(Mute(instruction="dashboard"))
    rig.arm.stop()
    assert isinstance(moving.wait().error, errors.MotionStopped)
    rig.comes_to_rest()


def test_S10_moves_are_asynchronous_so_that_a_stop_can_come_between(rig: ArmRig) -> None:
    rig.arm.move_joints([0.1, *AT_HOME[1:]])
    rig.arm.move_line([*rig.arm.state().pose[:2], rig.arm.state().pose[2] + 0.02, *rig.arm.state().pose[3:]])
    assert len(instructions(rig.log, "move_j")) == len(instructions(rig.log, "move_l")) == 1
    assert not [entry for entry in rig.moves() if "until it ends" in entry.detail]


@pytest.fixture
def shared(free: ArmRig, start_container: Callable[..., Container]) -> ArmRig:
    """The arm in a container."""
    driver = start_container("driver")
    free.attach(register=driver.register, deregister=driver.deregister)
    return free


@pytest.fixture
def planner(start_container: Callable[..., Container]) -> Container:
    return start_container("planner")


def test_S05_set_points_end_with_their_session(
    shared: ArmRig, planner: Container, start_container: Callable[..., Container]
) -> None:
    guide = start_container("guide")
    guide.find(where(name="servo", group="ada.right")).with_(deadline_s=60).start(FAR, 1.0)
    wait_until(lambda: shared.base_rad > 0.03, "it is under way")
    guide.close()
    closed = written_now()
    shared.comes_to_rest()
    ended = [*instructions(shared.log, "stop_j"), *instructions(shared.log, "servo_stop")]
    assert ended
    wait_until(lambda: answers(shared.arm, closed + 0.5), "time has passed")
    assert not shared.moves(max(closed, ended[-1].t))
    planner.find(where(name="move_joints", group="ada.right")).with_(deadline_s=30)(AT_HOME)


def test_S05_the_end_of_a_session_ends_freedrive(shared: ArmRig, start_container: Callable[..., Container]) -> None:
    guide = start_container("guide")
    guide.find(where(name="freedrive", group="ada.right")).with_(deadline_s=20)(True)
    assert shared.truth.freedrive
    guide.close()
    wait_until(lambda: not shared.truth.freedrive, "it holds itself again")


def _is_gone(arm: Arm) -> bool:
    try:
        arm.state()
    except errors.BusGone:
        return True
    except errors.DeviceSilent:
        return False
    return False


def _freezes_who_looks() -> bool:
    found = children("states")
    for pid in found:
        os.kill(pid, signal.SIGSTOP)
    return bool(found)
