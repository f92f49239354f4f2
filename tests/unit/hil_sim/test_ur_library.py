"""The vendor's library, unmodified, on a simulated controller: all four of its classes, in a process of their own.

Its constructors hold the interpreter's lock, so neither the simulator nor the test's deadline could run beside them.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade_hil_sim import Arm, UrBus, events, instructions, motion_writes
from trade_hil_sim.ur import HOME

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this platform")
DEADLINE_S = 60


@pytest.fixture
def controller() -> Iterator[UrBus]:
    with UrBus() as bus:
        yield bus


def run(controller: UrBus, program: str) -> Any:
    """What a program prints as JSON; it finds the address in ``host``."""
    program = f"import json, sys, time\nhost = sys.argv[1]\n{program}\nsys.stdout.flush()\nimport os; os._exit(0)"
    done = subprocess.run(
        [sys.executable, "-c", program, controller.port],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(next(line for line in reversed(done.stdout.splitlines()) if line.startswith(("[", "{"))))


@pytest.mark.slow
def test_the_receive_interface_reads_a_stream_that_advances(controller: UrBus) -> None:
    reported = run(
        controller,
        """
from rtde_receive import RTDEReceiveInterface
r = RTDEReceiveInterface(host)
first = r.getTimestamp()
seen = set()
while len(seen) < 100:
    seen.add(r.getTimestamp())
print(json.dumps({"q": r.getActualQ(), "pose": r.getActualTCPPose(), "mode": r.getRobotMode(),
    "safe": r.getSafetyMode(), "connected": r.isConnected(), "advances": max(seen) > first}))
""",
    )
    assert reported["q"] == pytest.approx(HOME)
    assert reported["pose"] == pytest.approx(controller.arm.pose(), abs=1e-6)
    assert (reported["mode"], reported["safe"], reported["connected"], reported["advances"]) == (7, 1, True, True)


def test_the_dashboard_client_asks_and_orders(controller: UrBus) -> None:
    reported = run(
        controller,
        """
from dashboard_client import DashboardClient
d = DashboardClient(host)
d.connect()
answers = [d.robotmode(), d.safetystatus(), d.programState(), d.getSerialNumber(), d.getRobotModel()]
flags = [d.isInRemoteControl(), d.running()]
d.play()
flags.append(d.running())
d.stop()
flags.append(d.running())
d.powerOff()
answers.append(d.robotmode())
d.brakeRelease()
deadline = time.monotonic() + 20
while "RUNNING" not in d.robotmode() and time.monotonic() < deadline:
    time.sleep(0.02)
answers.append(d.robotmode())
d.disconnect()
print(json.dumps([answers, flags]))
""",
    )
    answers, flags = reported
    assert answers[:2] == ["Robotmode: RUNNING", "Safetystatus: NORMAL"]
    assert answers[2].startswith("STOPPED")
    assert answers[3:5] == ["20210000001", "UR5"]
    assert answers[5:] == ["Robotmode: POWER_OFF", "Robotmode: RUNNING"]
    assert flags == [True, False, True, False]


def test_the_io_interface_sets_the_speed_slider(controller: UrBus) -> None:
    reported = run(
        controller,
        """
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface
io, r = RTDEIOInterface(host), RTDEReceiveInterface(host)
ok = io.setSpeedSlider(0.25)
deadline = time.monotonic() + 20
while r.getTargetSpeedFraction() != 0.25 and time.monotonic() < deadline:
    time.sleep(0.01)
print(json.dumps([ok, r.getTargetSpeedFraction()]))
""",
    )
    assert reported == [True, 0.25]
    assert controller.state().arms[0].speed_fraction == 0.25


CONTROL = """
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
c = RTDEControlInterface(host)
r = RTDEReceiveInterface(host)
q = r.getActualQ()
def until(true):
    deadline = time.monotonic() + 20
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.005)
"""


@pytest.mark.slow
def test_the_control_interface_moves_in_joint_space_and_along_a_line(controller: UrBus) -> None:
    reported = run(
        controller,
        CONTROL
        + """
goal = [q[0] + 0.2, *q[1:]]
ok = [c.moveJ(goal, 2.0, 8.0)]
until(lambda: abs(r.getActualQ()[0] - goal[0]) < 1e-7)
after = r.getActualQ()
pose = c.getForwardKinematics(after, [0.0] * 6)
line = r.getActualTCPPose()
line[2] -= 0.05
ok.append(c.moveL(line, 0.5, 2.0))
until(lambda: abs(r.getActualTCPPose()[2] - line[2]) < 1e-4)
print(json.dumps({"ok": ok, "off": after[0] - goal[0], "pose": pose, "end": r.getActualTCPPose(), "line": line}))
""",
    )
    assert reported["ok"] == [True, True]
    assert reported["pose"] == pytest.approx(controller.arm.pose((HOME[0] + 0.2, *HOME[1:])), abs=1e-6)
    assert abs(reported["off"]) < 1e-6
    assert reported["end"] == pytest.approx(reported["line"], abs=1e-4)
    wait_until(lambda: len(events(controller.log.entries, "at_rest")) == 2, "both moves have come to rest")
    assert all(
        "until it ends" in entry.detail for entry in motion_writes(controller.log.entries) if entry.name != "upload"
    )


@pytest.mark.parametrize("model", ["UR5", "UR5e"])
def test_all_interfaces_work_with_controllers_of_both_series(model: str) -> None:
    with UrBus(Arm(model)) as controller:
        reported = run(
            controller,
            CONTROL
            + """
from dashboard_client import DashboardClient
from rtde_io import RTDEIOInterface
d = DashboardClient(host)
d.connect()
goal = [q[0] + 0.1, *q[1:]]
scaled = RTDEIOInterface(host).setSpeedSlider(0.9)
print(json.dumps([d.polyscopeVersion().split(".")[0], scaled, c.moveJ(goal, 2.0, 8.0)]))
""",
        )
        assert reported == ["5" if model.endswith("e") else "3", True, True]
        assert controller.state().arms[0].positions_rad[0] == pytest.approx(HOME[0] + 0.1)


def test_the_angles_for_a_pose_are_computed_and_an_unreachable_pose_is_reported(controller: UrBus) -> None:
    reported = run(
        controller,
        CONTROL
        + """
pose = r.getActualTCPPose()
near = [angle + 0.1 for angle in q]
print(json.dumps([c.getInverseKinematics(pose, near), c.getInverseKinematicsHasSolution(pose, near),
    c.getInverseKinematicsHasSolution([5.0, *pose[1:]], near)]))
""",
    )
    assert reported[0] == pytest.approx(HOME, abs=1e-6)
    assert reported[1:] == [True, False]


def test_an_asynchronous_move_reports_its_progress_and_is_stopped(controller: UrBus) -> None:
    reported = run(
        controller,
        CONTROL
        + """
ok = c.moveJ([q[0] + 1.5, *q[1:]], 0.5, 2.0, True)
running = c.getAsyncOperationProgressEx().isAsyncOperationRunning()
until(lambda: abs(r.getActualQ()[0] - q[0]) > 0.02)
c.stopJ(4.0)
stopped = c.getAsyncOperationProgressEx().isAsyncOperationRunning()
until(lambda: not any(r.getActualQd()))
print(json.dumps([ok, running, stopped, r.getActualQ()[0] - q[0]]))
""",
    )
    ok, running, stopped, way = reported
    assert (ok, running, stopped) == (True, True, False)
    assert 0.02 < way < 1.0


@pytest.mark.slow
def test_a_stream_of_set_points_arrives_whole_and_is_followed(controller: UrBus) -> None:
    reported = run(
        controller,
        CONTROL
        + """
sent = 0
for k in range(250):
    start = c.initPeriod()
    target = [q[0] + 0.2 * k / 250, *q[1:]]
    sent += c.servoJ(target, 0.5, 0.5, 0.002, 0.1, 300)
    c.waitPeriod(start)
until(lambda: abs(r.getActualQ()[0] - target[0]) < 1e-3)
c.servoStop()
c.stopScript()
print(json.dumps([sent, r.getActualQ()[0] - q[0]]))
""",
    )
    sent, way = reported
    assert sent == len(instructions(controller.log.entries, "servo_j")) == 250
    assert way == pytest.approx(0.2 * 249 / 250, abs=0.01)  # set-points that come in a heap make it swing
    assert controller.state().arms[0].program == ""


def test_a_watchdog_that_is_not_fed_ends_the_program_and_the_motion(controller: UrBus) -> None:
    reported = run(
        controller,
        CONTROL
        + """
armed = c.setWatchdog(10.0)
c.moveJ([q[0] + 3.0, *q[1:]], 0.3, 1.0, True)
until(lambda: not c.isProgramRunning())
print(json.dumps([armed, c.moveJ([q[0], *q[1:]], 0.3, 1.0)]))
""",
    )
    assert reported == [True, False]
    assert len(events(controller.log.entries, "watchdog_expired")) == 1
    assert abs(controller.state().arms[0].positions_rad[0]) < 1.0


def test_freedrive_and_a_protective_stop_are_seen_by_the_library(controller: UrBus) -> None:
    reported = run(
        controller,
        CONTROL
        + """
flags = [c.teachMode()]
until(lambda: r.getRobotStatus() & 4)
flags.append(c.endTeachMode())
c.triggerProtectiveStop()
until(r.isProtectiveStopped)
flags += [c.isProgramRunning(), c.moveJ(q, 1.0, 1.0)]
print(json.dumps([flags, r.getSafetyMode()]))
""",
    )
    assert reported == [[True, True, False, False], 3]


def test_a_second_client_for_control_ends_the_program_of_the_first(controller: UrBus) -> None:
    run(controller, CONTROL + "print(json.dumps([]))")
    assert controller.state().arms[0].program == "control"
    run(controller, CONTROL + "print(json.dumps([]))")
    assert len(events(controller.log.entries, "program_stopped")) == 1
    assert len(events(controller.log.entries, "program_started")) == 2
