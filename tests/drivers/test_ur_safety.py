"""Safety of the arm driver, rule by rule; the judge is what the simulated controller received and did."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import psutil
import pytest

from arms import ARM, AT_HOME, attached
from drivers.conftest import Outcome, call, sleep_past, written_now
from trade import Container, where
from trade.errors import DeadlineExceeded, DeviceFault, DeviceSilent, LockedByOther, MotionStopped, Stopped
from trade_drivers import Arm
from trade_hil_sim import Absent, BrownOut, Entry, Mute, Replug, Unplug, UrBus, events, instructions, motion_writes
from waiting import wait_until

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
FAR = [3.0, *AT_HOME[1:]]
SLOW = 0.3


class Rig:
    """A simulated arm, and the driver attached to it."""

    def __init__(self, undo: ExitStack, **options: object) -> None:
        self.sim, self.robot = attached(undo, **options)  # type: ignore[arg-type]
        self.arm: Arm = self.robot.arm("right")

    @property
    def log(self) -> list[Entry]:
        return self.sim.log.entries

    @property
    def moving(self) -> bool:
        return self.sim.state().arms[0].moving

    @property
    def base_rad(self) -> float:
        return self.sim.state().arms[0].positions_rad[0]

    def moves(self, since: float = 0.0) -> list[Entry]:
        return motion_writes(self.log, since=since)

    def set_off(self) -> Outcome:
        """Have it move far and slowly."""
        moving = Outcome(lambda: self.arm.move_joints(FAR, SLOW))
        wait_until(lambda: self.base_rad > 0.05, "it is under way")
        return moving

    def stands(self) -> None:
        wait_until(lambda: not self.moving, "it stands")
        assert self.base_rad < FAR[0] - 0.5


@pytest.fixture
def rig() -> Iterator[Rig]:
    with ExitStack() as undo:
        yield Rig(undo)


def children(role: str) -> list[int]:
    found: list[int] = []
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # it has just ended
            if f"trade_drivers.ur._{role}_child" in child.cmdline():
                found.append(child.pid)
    return found


# --- S01, S04


def test_S01_a_command_whose_time_has_passed_is_never_sent(rig: Rig) -> None:
    with call(0.2) as expires_ns:
        sleep_past(expires_ns)
        with pytest.raises(DeadlineExceeded):
            rig.arm.move_joints(FAR)
    assert not rig.moves()


def test_S01_what_waits_in_the_process_that_commands_expires_there(rig: Rig) -> None:
    rig.arm.move_joints([0.05, *AT_HOME[1:]])  # control is taken
    [pid] = children("control")
    os.kill(pid, signal.SIGSTOP)
    mark = written_now()
    late = Outcome(lambda: rig.arm.move_joints(FAR), deadline_s=0.1)
    sleep_past(int((mark + 0.15) * 1e9))
    os.kill(pid, signal.SIGCONT)
    assert isinstance(late.wait().error, DeadlineExceeded | MotionStopped | DeviceFault)
    wait_until(lambda: _answers(rig.arm, mark + 0.5), "time has passed")
    assert not rig.moves(mark)


def test_S04_a_set_point_that_is_not_renewed_ends_in_a_stop(rig: Rig) -> None:
    rig.arm.servo(FAR, 0.3)
    wait_until(lambda: rig.base_rad > 0.02, "it is under way")
    rig.stands()
    last = rig.moves()[-1]
    wait_until(lambda: instructions(rig.log, "servo_stop", since=last.t), "the stream is ended")
    mark = written_now()
    wait_until(lambda: rig.arm.state().measured_at > mark + 0.1, "time has passed")
    assert not rig.moves(mark)


# --- S06


class Driver:
    """A driver in a process of its own that moves the arm."""

    def __init__(self, sim: UrBus, folder: Path, how: str) -> None:
        file = folder / "arm.toml"
        file.write_text(ARM)
        program = Path(__file__).with_name("arm_process.py")
        self.process = subprocess.Popen([sys.executable, str(program), str(file), sim.port, how])

    def close(self) -> None:
        family = psutil.Process(self.process.pid).children()
        self.process.kill()
        self.process.wait()
        psutil.wait_procs(family, 20)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["kill -9", "SIGSTOP"])
@pytest.mark.parametrize("how", ["move", "servo"])
def test_S06_without_its_driver_the_arm_stops(tmp_path: Path, number: int, how: str) -> None:
    with ExitStack() as undo:
        sim = undo.enter_context(UrBus(name="ur"))
        driver = Driver(sim, tmp_path, how)
        undo.callback(driver.close)
        wait_until(lambda: sim.state().arms[0].positions_rad[0] > 0.05, "it is under way")
        os.kill(driver.process.pid, number)
        mark = written_now()
        wait_until(lambda: not sim.state().arms[0].moving, "it stands")
        assert sim.state().arms[0].positions_rad[0] < FAR[0] - 0.5
        wait_until(lambda: events(sim.log.entries, "program_stopped", since=mark), "its program has ended")
        stopped = events(sim.log.entries, "program_stopped", since=mark)[0]
        assert not motion_writes(sim.log.entries, since=stopped.t)


def test_S06_a_process_that_commands_and_is_killed_leaves_the_stop_to_the_watchdog_of_the_robot(rig: Rig) -> None:
    moving = rig.set_off()
    [pid] = children("control")
    os.kill(pid, signal.SIGKILL)
    assert isinstance(moving.wait().error, DeviceFault)
    rig.stands()
    assert events(rig.log, "watchdog_expired")
    wait_until(lambda: children("control"), "there is a new one")
    mark = written_now()
    assert children("control") != [pid]
    wait_until(lambda: rig.arm.state().measured_at > mark + 0.2, "time has passed")
    assert not rig.moves(mark)  # restarted, but not into motion
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)


def test_S06_an_unhealthy_process_holds_once_and_does_not_feed_the_watchdog() -> None:
    well = threading.Event()
    well.set()
    with ExitStack() as undo:
        rig = Rig(undo, healthy=well.is_set)
        moving = rig.set_off()
        well.clear()
        assert moving.wait().error is not None
        rig.stands()
        wait_until(lambda: rig.sim.state().arms[0].program == "", "its program has ended")
        mark = written_now()
        with pytest.raises(DeviceFault, match="not healthy"):
            rig.arm.move_joints(FAR)
        assert not rig.moves(mark)


# --- S08, S10


def test_S10_a_stop_goes_through_the_dashboard_and_the_process_that_commands(rig: Rig) -> None:
    moving = rig.set_off()
    mark = written_now()
    rig.arm.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    assert not rig.moving
    assert [e for e in instructions(rig.log, "dashboard", since=mark) if e.detail.startswith("stop ->")]
    assert not rig.moves(mark)
    rig.stands()


def test_S10_a_process_that_does_not_answer_a_stop_is_killed_and_the_arm_stands(rig: Rig) -> None:
    moving = rig.set_off()
    [pid] = children("control")
    os.kill(pid, signal.SIGSTOP)
    rig.arm.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    rig.stands()
    wait_until(lambda: children("control") and children("control") != [pid], "it is killed and replaced")
    assert rig.arm.move_to_pose("home")[0] == pytest.approx(0.0, abs=0.01)


def test_S10_a_dashboard_that_does_not_answer_does_not_hinder_a_stop(rig: Rig) -> None:
    moving = rig.set_off()
    rig.sim.do(Mute(instruction="dashboard"))
    rig.arm.stop()
    assert isinstance(moving.wait().error, MotionStopped)
    rig.stands()


def test_S10_moves_are_asynchronous_so_that_a_stop_can_come_between(rig: Rig) -> None:
    rig.arm.move_joints([0.1, *AT_HOME[1:]])
    rig.arm.move_line([*rig.arm.state().pose[:2], rig.arm.state().pose[2] + 0.02, *rig.arm.state().pose[3:]])
    assert len(instructions(rig.log, "move_j")) == len(instructions(rig.log, "move_l")) == 1
    assert not [entry for entry in rig.moves() if "until it ends" in entry.detail]


def test_S08_what_was_admitted_before_a_stop_is_dropped(rig: Rig) -> None:
    released, reached = threading.Event(), threading.Event()
    rig.arm.move_joints([0.05, *AT_HOME[1:]])  # control is taken
    exchange = rig.arm._exchange  # type: ignore[attr-defined]
    listen = exchange.listen

    def held_up() -> None:
        reached.set()
        released.wait(20)
        listen()

    exchange.listen = held_up
    assert reached.wait(20)
    mark = written_now()
    waiting = Outcome(lambda: rig.arm.move_joints(FAR))
    wait_until(lambda: exchange._inbox, "it waits")
    stopping = Outcome(rig.arm.stop)
    wait_until(lambda: exchange._stops, "the stop has come")
    exchange.listen = listen
    released.set()
    assert isinstance(waiting.wait().error, MotionStopped)
    assert stopping.wait().error is None
    assert not rig.moves(mark)


# --- S08, S11 with containers


@pytest.fixture
def shared(start_container: Callable[..., Container]) -> Iterator[tuple[Rig, Container, Container]]:
    """The arm in one container, and two others."""
    driver = start_container("driver")
    with ExitStack() as undo:
        rig = Rig(undo, register=driver.register, deregister=driver.deregister)
        yield rig, start_container("planner"), start_container("other")


def test_S08_a_stop_by_somebody_else_latches_until_resumed(shared: tuple[Rig, Container, Container]) -> None:
    rig, planner, other = shared
    move = planner.find(where(name="move_joints", group="ada.right"))
    run = move.with_(deadline_s=30).start(FAR, SLOW)
    wait_until(lambda: rig.base_rad > 0.05, "it is under way")
    other.find(where(name="stop", group="ada.right"))()
    with pytest.raises(MotionStopped):
        run.result()
    mark = written_now()
    with pytest.raises(Stopped):
        move(AT_HOME)
    assert not rig.moves(mark)
    other.resume(where(group="ada.right"))
    assert move.with_(deadline_s=30)(AT_HOME)[0] == pytest.approx(0.0, abs=0.01)


def test_S11_who_has_no_lock_moves_nothing_while_somebody_has(shared: tuple[Rig, Container, Container]) -> None:
    rig, planner, other = shared
    stranger = other.find(where(name="move_joints", group="ada.right"))
    with planner.lock(where(group="ada.right")):
        for act in (lambda: stranger(FAR), lambda: rig.arm.move_joints(FAR), lambda: rig.arm.freedrive(True)):
            with pytest.raises(LockedByOther):
                act()
        assert not rig.moves()
        move = planner.find(where(name="move_joints", group="ada.right"))
        move.with_(deadline_s=30)([0.1, *AT_HOME[1:]])
    assert len(instructions(rig.log, "move_j")) == 1


def test_S05_the_end_of_a_session_ends_freedrive_and_streams(
    shared: tuple[Rig, Container, Container], start_container: Callable[..., Container]
) -> None:
    rig, _, _ = shared
    guide = start_container("guide")
    guide.find(where(name="freedrive", group="ada.right")).with_(deadline_s=20)(True)
    assert rig.sim.state().arms[0].freedrive
    guide.close()
    wait_until(lambda: not rig.sim.state().arms[0].freedrive, "it holds itself again")


# --- S18


def test_S18_attaching_uploads_and_moves_nothing(rig: Rig) -> None:
    assert not rig.moves()
    assert not instructions(rig.log, "upload")
    asked = {e.detail.partition(" -> ")[0] for e in instructions(rig.log, "dashboard")}
    assert asked == {"robotmode", "get robot model"}


def test_S18_an_arm_found_moving_is_stopped() -> None:
    with ExitStack() as undo:
        sim = undo.enter_context(UrBus(name="ur"))
        sim._in_thread(sim._program.play)
        wait_until(lambda: sim.state().arms[0].moving, "its own program moves it")
        attached(undo, host=sim.port)
        wait_until(lambda: not sim.state().arms[0].moving, "it stands")
        assert not motion_writes(sim.log.entries)


@pytest.mark.parametrize("how", ["cable", "reboot", "silence"])
def test_S18_a_controller_that_comes_back_is_read_and_not_commanded(rig: Rig, how: str) -> None:
    moving = rig.set_off()
    rig.sim.do({"cable": Unplug(), "reboot": BrownOut(), "silence": Absent()}[how])
    assert isinstance(moving.wait().error, DeviceSilent | DeviceFault)
    wait_until(lambda: not rig.moving, "it stands")
    mark = written_now()
    if how == "cable":
        rig.sim.do(Replug())
    if how == "silence":
        rig.sim.do(Absent(on=False))
    wait_until(lambda: _answers(rig.arm, mark), "it is read again")
    assert not rig.moves(mark)
    assert rig.arm.state().enabled == (how != "reboot")


def test_S18_power_and_brakes_are_switched_on_request_only(rig: Rig) -> None:
    mark = written_now()
    rig.sim.do(BrownOut())
    wait_until(lambda: _answers(rig.arm, mark) and not rig.arm.state().powered, "it is read again, without power")
    with pytest.raises(DeviceFault, match="power_on"):
        rig.arm.move_joints(FAR)
    with pytest.raises(DeviceFault, match="power is off"):
        rig.arm.release_brakes()
    rig.arm.power_on()
    assert rig.arm.state().powered
    with pytest.raises(DeviceFault, match="release_brakes"):
        rig.arm.move_joints(FAR)
    rig.arm.release_brakes()
    assert rig.arm.move_joints([0.1, *AT_HOME[1:]])[0] == pytest.approx(0.1, abs=0.01)


def _answers(arm: Arm, since: float) -> bool:
    try:
        return arm.state().measured_at > since
    except DeviceSilent:
        return False
