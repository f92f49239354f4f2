"""The processes of the jitter part: a driver and its bus thread, alone or in `trade up`, and an empty loop."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

from tests.bench._children import _requests
from tests.bench._rosie import _WIDE, _through
from trade import Container, Settings, handle_of
from trade.errors import TradeError
from trade_drivers import Arm, AttachedRobot, Gripper, JointGroup, Motor, attach, parse
from trade_robotfile import Robot

GROUP = "others"
ANYWHERE = "/dev/ttyNOWHERE"
"""The port in a robot file of a serial bus, before there is a simulation."""
CAN0 = 'interface = "socketcan"\nchannel = "can0"'
"""The same of a CAN bus."""
ADDRESS = "192.168.0.10"
"""The same of a controller."""
_FOUND_S, _LONG_S = 30.0, 600.0
_WAY_RAD, _ACCEL_RAD_S2 = 0.2, 2.2


def drive(pipe: Connection, text: str, ports: Mapping[str, str]) -> None:
    """Attach a robot of one bus, say the number of this process, then keep it busy for the seconds that are asked.

    A first joint is left without torque; the group and an arm follow a trajectory; a gripper stays at rest.
    Each request is answered with when that began and ended (CLOCK_MONOTONIC), and with what ended the motion before its
    time, or nothing: too busy a machine holds a bus up. The loop turns on, and how late it was is what is measured.
    """
    robot = parse(text, "jitter.toml")
    with attach(robot, announced=False, ports=ports) as attached:
        busy = busy_with(robot, attached)
        pipe.send(os.getpid())
        for seconds in _requests(pipe):
            pipe.send(_timed(busy, seconds))


def bring_up(pipe: Connection, text: str, port: str, folder: Path, *, real: bool) -> None:
    """The same of a robot that `trade up` brings up, in real time or not; this process is its client.

    Its system and its files are in a folder.
    """
    os.environ.update(TRADE_SYSTEM="bench-jitter", TRADE_RUNTIME_DIR=str(folder), TRADE_STATE_DIR=str(folder))
    file = folder / "up.toml"
    adapter = f'interface = "socketcand"\nchannel = "{port.removeprefix("socketcand:")}"'
    file.write_text(text.replace(ANYWHERE, port).replace(CAN0, adapter).replace(ADDRESS, port))
    words = ["--with-stdin", "up", str(file), "--json", *(() if real else ("--no-real-time",))]
    command = [sys.executable, "-m", "trade_gateway", *words]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as up:
        try:
            assert up.stdout is not None
            json.loads(up.stdout.readline())
            with Container(Settings.read(container="client")) as container:
                busy = busy_with(parse(text, "jitter.toml"), _Served(container))
                pipe.send(up.pid)
                for seconds in _requests(pipe):
                    pipe.send(_timed(busy, seconds))
        finally:
            up.terminate()


class _Served:
    """The services of a robot, with the methods of an attached one that keep it busy."""

    def __init__(self, container: Container) -> None:
        self._container = container

    def motor(self, joint: str) -> Motor:
        return self._container.find(Motor, group=f"bench.{joint}", wait_s=_FOUND_S)

    def group(self, name: str) -> JointGroup:
        return self._container.find(JointGroup, group=f"bench.{name}", wait_s=_FOUND_S)

    def gripper(self, name: str) -> Gripper:
        return self._container.find(Gripper, group=f"bench.{name}", wait_s=_FOUND_S)

    def arm(self, name: str) -> Arm:
        return self._container.find(Arm, group=f"bench.{name}", wait_s=_FOUND_S)


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


def busy_with(robot: Robot, attached: AttachedRobot | _Served) -> Callable[[float], object]:
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
    return _following(robot, attached)


def _following(robot: Robot, attached: AttachedRobot | _Served) -> Callable[[float], object]:
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
    here = isinstance(mover, (Arm, JointGroup))  # else it is a proxy, whose call has a deadline
    follow = mover.follow if here else handle_of(mover.follow).with_(deadline_s=_LONG_S)
    follow(_through(joints, (0.0, start_rad), (seconds / 2, there), (seconds, start_rad)), _WIDE)
