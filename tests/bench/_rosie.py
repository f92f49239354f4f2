"""What a whole robot costs the computer on it: all drivers of rosie at the rates of the issue, with simulated devices.

Drives at 200 Hz, servos at 100 Hz, the gripper at 20 Hz. The legs follow a trajectory meanwhile: that is the most that
their driver has to do.
"""

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.bench._report import print_target

from trade.errors import TradeError
from trade_drivers import AttachedRobot, Tolerances, Trajectory, TrajectoryPoint, attach
from trade_drivers.robotfile import parse
from trade_hil_sim import SimProcess

_ROSIE = Path(__file__).parents[2] / "examples" / "rosie.toml"
_RATES_HZ = {"neck": 100, "hand": 20, "legs": 200}
_LEGS = "legs"
_MOST = 50.0
_WAY_RAD = 0.3
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
    if shares:
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
    """Processor time of this process as a share of one core, in per cent, while the legs are on their way."""
    robot = parse(file.read_text(), file.name)
    with SimProcess(file, logged=False) as sim:
        attached = attach(robot, register=lambda *_: None, deregister=lambda *_: None, ports=sim.ports)
        try:
            return _busy(attached, seconds)
        finally:
            attached.close()


def _busy(attached: AttachedRobot, seconds: float) -> float:
    legs = attached.group(_LEGS)
    for joint in legs.joints():
        attached.motor(joint.removeprefix("rosie.")).enable()
    stands = [state.position_rad for state in legs.state()]
    there = [angle + _WAY_RAD for angle in stands]
    began, spent = time.monotonic(), time.process_time()
    legs.follow(_through(legs.joints(), (0.0, stands), (seconds / 2, there), (seconds, stands)), _WIDE)
    return 100 * (time.process_time() - spent) / (time.monotonic() - began)


def _through(joints: Sequence[str], *points: tuple[float, Sequence[float]]) -> Trajectory:
    stops = [TrajectoryPoint(time_from_start_s=at_s, positions_rad=list(at_rad)) for at_s, at_rad in points]
    return Trajectory(joints=list(joints), points=stops)
