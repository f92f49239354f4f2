"""What a whole robot costs the computer on it: all drivers of rosie at the rates of the issue, with simulated devices.

What is on CAN at 200 Hz, servos at 100 Hz, the arm at 125 Hz, the gripper at 20 Hz. All joints follow trajectories
meanwhile: that is the most that drivers have to do. What they start counts, too: the arm is commanded from processes.
"""

import sys
import tempfile
import time
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import psutil

from tests.bench._report import keep_point, print_skipped, print_target
from trade.errors import TradeError
from trade_drivers import Arm, AttachedRobot, JointGroup, Tolerances, Trajectory, TrajectoryPoint, attach, parse
from trade_hil_sim import SimProcess

_ROSIE = Path(__file__).parents[2] / "examples" / "rosie.toml"
_RATES_HZ = {"neck": 100, "left_arm": 125, "hand": 20, "right_arm": 100, "legs": 200, "tail": 200}
_GROUPS = ("head", "right.arm", "legs", "tail")
_ARM = "left.arm"
_MOST = 70.0
_WAY_RAD = 0.2
_WIDE = Tolerances(start_rad=1.0, path_rad=2.0, goal_rad=1.0, goal_time_s=5.0)


def run(rounds: int, seconds: float) -> None:
    """Measure and print.

    Args:
        rounds: trajectories.
        seconds: how long one lasts.
    """
    shares: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / _ROSIE.name
        file.write_text(_at_rates(_ROSIE.read_text()))
        for i in range(rounds):
            try:
                shares.append(_share(file, seconds))
            except TradeError as lost:  # too busy a machine loses devices
                print(f"rosie: a round is left out: {lost}", file=sys.stderr, flush=True)
            print(f"rosie: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    rates = ", ".join(f"{name} {rate_hz} Hz" for name, rate_hz in _RATES_HZ.items())
    print(f"rosie's drivers: {rates}; {len(shares)} of {rounds} rounds")
    if not shares:
        print_skipped("rosie", "devices were lost in every round: the machine is too busy")
        return
    keep_point("all joints on their way", "all drivers", len(shares), {"% of a core": shares})
    print_target("all drivers: % of a core", shares, f"at most {_MOST:g}", lambda share: share <= _MOST)


def _at_rates(text: str) -> str:
    """The robot file with the rates of this bench."""
    lines: list[str] = []
    bus = ""
    for line in text.splitlines():
        if line.startswith("["):
            bus = line.strip("[]").removeprefix("bus.")
        lines.append(f"rate_hz = {_RATES_HZ[bus]}" if line.startswith("rate_hz") else line)
    return "\n".join(lines)


def _share(file: Path, seconds: float) -> float:
    """Processor time of the drivers as a share of one core, in per cent, while all joints are on their way."""
    robot = parse(file.read_text(), file.name)
    with ExitStack() as undo:  # a process for each bus: one for all would be the slowest part of it
        sims = [undo.enter_context(SimProcess(file, buses=[bus.name], logged=False)) for bus in robot.buses]
        ports = {name: port for sim in sims for name, port in sim.ports.items()}
        attached = attach(robot, announced=False, ports=ports)
        undo.callback(attached.close)
        return _busy(attached, seconds, _drivers({sim.pid for sim in sims}))


def _drivers(others: Collection[int]) -> list[psutil.Process]:
    """This process and those that drivers started."""
    me = psutil.Process()
    return [me, *(each for each in me.children(recursive=True) if each.pid not in others)]


def _busy(attached: AttachedRobot, seconds: float, drivers: Sequence[psutil.Process]) -> float:
    for joint in attached.robot.joints:
        attached.motor(joint.name).enable()
    arm = attached.arm(_ARM)
    arm.power_on()
    arm.release_brakes()
    groups = [attached.group(name) for name in _GROUPS]
    ways: list[tuple[Arm | JointGroup, Trajectory]] = [
        (arm, _there_and_back([limits.name for limits in arm.limits().joints], arm.state().positions_rad, seconds)),
        *(
            (each, _there_and_back(each.joints(), [state.position_rad for state in each.state()], seconds))
            for each in groups
        ),
    ]
    began, spent = time.monotonic(), _spent_s(drivers)
    with ThreadPoolExecutor(len(ways)) as pool:
        for done in [pool.submit(each.follow, way, _WIDE) for each, way in ways]:
            done.result()
    return 100 * (_spent_s(drivers) - spent) / (time.monotonic() - began)


def _spent_s(processes: Sequence[psutil.Process]) -> float:
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def _there_and_back(joints: Sequence[str], start_rad: Sequence[float], seconds: float) -> Trajectory:
    there = [angle + _WAY_RAD for angle in start_rad]
    return _through(joints, (0.0, start_rad), (seconds / 2, there), (seconds, start_rad))


def _through(joints: Sequence[str], *points: tuple[float, Sequence[float]]) -> Trajectory:
    stops = [TrajectoryPoint(time_from_start_s=at_s, positions_rad=list(at_rad)) for at_s, at_rad in points]
    return Trajectory(joints=list(joints), points=stops)
