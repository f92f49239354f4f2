"""The same seed gives the same bytes on a bus, in any process."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.realtime  # it starts processes

STORY = """
import hashlib, logging, sys
from pathlib import Path

from trade.testing import memory_system, virtual_time
from trade_drivers import attach, parse
from trade_hil_sim.feetech import FeetechBus

logging.disable()
JOINT = '[joint.{}]\\nbus = "tail"\\nid = {}\\nmodel = "STS3215"\\nmin_rad = -1.5\\nmax_rad = 1.5\\n'
SPEED = 'max_speed_rad_s = 3.0\\nmax_accel_rad_s2 = 10.0\\n'
BUS = '[robot]\\nname = "rosie"\\n[bus.tail]\\ndriver = "feetech"\\nport = "unused"\\nbaud = 1000000\\n'
robot = parse(BUS + JOINT.format("root", 1) + SPEED + JOINT.format("tip", 2) + SPEED, "tail.toml")
with virtual_time(seed=int(sys.argv[1]), switch=0.3) as time, memory_system() as system:
    container = system.container("robot")
    with FeetechBus.from_robot(robot.buses[0], robot.joints_on("tail"), Path("unused")) as sim:
        attached = attach(robot, container, ports={"tail": str(sim.port)})
        mind = system.container("mind")
        with mind.lock("rosie.root", wait_s=5):
            mind.call("rosie.root.move_to", 0.5)
        attached.close()
    log = repr(sim.log.entries)
print(hashlib.sha256(log.encode()).hexdigest(), len(log), time.switches, time.elapsed_s)
"""


def story(seed: int, hash_seed: int) -> str:
    environment = {**os.environ, "PYTHONHASHSEED": str(hash_seed)}
    command = [sys.executable, "-c", STORY, str(seed)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


def test_the_same_seed_gives_the_same_bytes_in_another_process() -> None:
    assert story(3, 1) == story(3, 2)
    assert story(3, 1).split()[0] != story(4, 1).split()[0]
