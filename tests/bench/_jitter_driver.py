"""The processes of the jitter part: one with a driver and its bus thread, one with a loop that does nothing."""

import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection

from tests.bench._children import _requests
from tests.bench._rosie import _WIDE, _through
from trade.errors import TradeError
from trade_drivers import Arm, AttachedRobot, JointGroup, attach
from trade_drivers.robotfile import Robot, parse

GROUP = "others"
_WAY_RAD, _ACCEL_RAD_S2 = 0.2, 2.2


def drive(pipe: Connection, text: str, ports: Mapping[str, str]) -> None:
    """Attach a robot of one bus, say the number of this process, then keep it busy for the seconds that are asked.

    A first joint is left without torque; the group and an arm follow a trajectory; a gripper stays at rest.
    Each request is answered with when that began and ended (CLOCK_MONOTONIC), and with what ended the motion before its
    time, or nothing: too busy a machine holds a bus up. The loop turns on, and how late it was is what is measured.
    """
    robot = parse(text, "jitter.toml")
    with attach(robot, register=lambda *_: None, deregister=lambda *_: None, ports=ports) as attached:
        busy = busy_with(robot, attached)
        pipe.send(os.getpid())
        for seconds in _requests(pipe):
            pipe.send(_timed(busy, seconds))


def idle(pipe: Connection, rate_hz: float) -> None:
    """The same of an empty loop, which also reports when each of its cycles began."""
    pipe.send(os.getpid())
    for seconds in _requests(pipe):
        began = [time.monotonic()]
        while began[-1] < began[0] + seconds:
            time.sleep(max(0.0, began[0] + len(began) / rate_hz - time.monotonic()))
            began.append(time.monotonic())
        pipe.send((began, ""))


def _timed(busy: Callable[[float], object], seconds: float) -> tuple[tuple[float, float], str]:
    began, problem = time.monotonic(), ""
    try:
        busy(seconds)
    except TradeError as lost:
        problem = f"{type(lost).__name__}: {lost}"
        time.sleep(max(0.0, began + seconds - time.monotonic()))
    return (began, time.monotonic()), problem


def busy_with(robot: Robot, attached: AttachedRobot) -> Callable[[float], object]:
    """What keeps it busy for so many seconds."""
    if robot.grippers:
        attached.gripper(robot.grippers[0].name).activate()
        return time.sleep
    if robot.arms:
        arm = attached.arm(robot.arms[0].name)
        arm.power_on()
        arm.release_brakes()
        names = [joint.name for joint in arm.limits().joints]
        return lambda seconds: _follow(arm, names, arm.state().positions_rad, seconds)
    group = attached.group(GROUP)
    motors = [attached.motor(joint) for one in robot.groups for joint in one.joints]

    def enable() -> None:
        for motor in motors:  # each with a deadline of its own: some wait for their watchdog the first time
            motor.enable()

    with suppress(TradeError):
        enable()

    def follow(seconds: float) -> None:
        enable()
        _follow(group, group.joints(), [state.position_rad for state in group.state()], seconds)

    return follow


def _follow(mover: Arm | JointGroup, joints: list[str], start_rad: list[float], seconds: float) -> None:
    """There and back, no faster than any of them may."""
    way_rad = min(_WAY_RAD, _ACCEL_RAD_S2 * seconds**2 / 24)
    there = [angle + way_rad for angle in start_rad]
    mover.follow(_through(joints, (0.0, start_rad), (seconds / 2, there), (seconds, start_rad)), _WIDE)
