"""The servo stream of an arm: how many set-points a second reach the controller, and what they cost.

The driver's bus thread follows a trajectory on a simulated controller. Beside it runs a bare loop of the vendor's
library, paced by itself, in a process of its own. What has arrived is counted in the simulator's log.
"""

import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from tests.bench._report import keep_point, print_skipped, print_target
from trade_drivers import Arm, Trajectory, TrajectoryPoint, attach, load
from trade_hil_sim import LogEntry, SimProcess, instructions

_ROBOT = Path(__file__).parents[2] / "examples" / "arm.toml"
_WAY_RAD = 0.3
_LEAST_HZ = 490
_BARE = """
import sys, time
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
host, seconds = sys.argv[1], float(sys.argv[2])
control = RTDEControlInterface(host)
q = RTDEReceiveInterface(host).getActualQ()
ends = time.monotonic() + seconds
while time.monotonic() < ends:
    start = control.initPeriod()
    control.servoJ(q, 0.0, 0.0, 0.002, 0.05, 500)
    control.waitPeriod(start)
control.servoStop()
control.stopScript()
import os; os._exit(0)
"""


def run(rounds: int, seconds: float) -> None:
    """Measure and print.

    Args:
        rounds: turns of each.
        seconds: how long a stream lasts.
    """
    try:
        import rtde_control  # noqa: F401
    except ImportError:
        print_skipped("arm", "ur-rtde is not installed")
        return
    driven: list[float] = []
    bare: list[float] = []
    loads: list[float] = []
    with SimProcess(_ROBOT) as sim:
        for i in range(rounds):
            rate, cores = _driven(sim, seconds)
            driven.append(rate)
            loads.append(cores)
            bare.append(_bare(sim, seconds))
            print(f"arm: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    print(f"\nservo stream of an arm, {rounds} rounds of {seconds:g} s")
    print(f"bare library: {median(bare):.0f} set-points/s ({min(bare):.0f}-{max(bare):.0f})")
    print(f"CPU of the driver: {100 * median(loads):.1f} % of a core ({100 * min(loads):.1f}-{100 * max(loads):.1f})")
    keep_point("servo stream", "driver", rounds, {"set-points/s": driven, "% of a core": [100 * one for one in loads]})
    keep_point("servo stream", "bare library", rounds, {"set-points/s": bare})
    print_target("set-points/s, driver", driven, f"at least {_LEAST_HZ}", lambda hz: hz >= _LEAST_HZ)


def _driven(sim: SimProcess, seconds: float) -> tuple[float, float]:
    robot = load(_ROBOT)
    with attach(robot, ports=sim.ports, announced=False) as attached:
        arm = attached.arm("right")
        arm.move_to_pose("home")
        mark, spent = time.monotonic(), time.process_time()
        arm.follow(_wave(arm, max(seconds, 1.0)))
        cores = (time.process_time() - spent) / (time.monotonic() - mark)
    return _rate(instructions(sim.entries(), "servo_j", since=mark)), cores


def _bare(sim: SimProcess, seconds: float) -> float:
    mark = time.monotonic()
    subprocess.run([sys.executable, "-c", _BARE, sim.ports["ur"], str(seconds)], check=True, timeout=60 + seconds)
    return _rate(instructions(sim.entries(), "servo_j", since=mark))


def _rate(stream: list[LogEntry]) -> float:
    return (len(stream) - 1) / (stream[-1].t - stream[0].t)


def _wave(arm: Arm, seconds: float) -> Trajectory:
    limits = arm.limits()
    home = limits.poses["home"]
    return Trajectory(
        joints=[joint.name for joint in limits.joints],
        points=[
            TrajectoryPoint(time_from_start_s=part * seconds, positions_rad=[*home[:-1], home[-1] + angle])
            for part, angle in ((0.0, 0.0), (0.5, min(_WAY_RAD, 0.09 * seconds**2)), (1.0, 0.0))
        ],
    )
