"""S07: the longest stretch in which a bus thread cannot be interrupted, counted in bytes, so on any machine."""

import random
import threading

import pytest

import trade_hil_sim
from drivers.conftest import Rig, wait_until, written_now
from trade_drivers import parse

BAUD, JOINTS = 57_600, 10
LONGEST_STRETCH_S = 0.050
ROUNDS = 15

BUS = f"""
[robot]
name = "rosie"

[bus.neck]
driver = "dynamixel"
port = "/dev/ttyNOWHERE"
baud = {BAUD}
rate_hz = 14
"""
JOINT = """
[joint.j{id}]
bus = "neck"
id = {id}
model = "XL430-W250"
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""
GROUP = f"[group.all]\njoints = {[f'j{i}' for i in range(1, JOINTS + 1)]}\n"


@pytest.mark.parametrize("silent", [(), (7,)], ids=["all answer", "one is silent"])
def test_S07_a_stop_waits_for_no_more_bytes_than_50_ms_carry(rig: Rig, silent: tuple[int, ...]) -> None:
    rig.robot = parse(BUS + "".join(JOINT.format(id=i) for i in range(1, JOINTS + 1)) + GROUP, "many.toml")
    rig.plug()
    robot = rig.attach()
    group, first = robot.group("all"), robot.motor("j1")
    group.enable()
    if silent:
        rig.sim.do(trade_hil_sim.Mute(ids=silent))
    chance, waited = random.Random(7), []
    for round_ in range(ROUNDS):
        goal = 0.9 if round_ % 2 else -0.9
        if silent:
            first.set_velocity(goal, 1.0)
        else:
            group.servo([goal] * JOINTS, 1.0)
        threading.Event().wait(chance.uniform(0.0, 0.15))
        asked = written_now()
        first.stop()
        waited.append(bytes_between(rig, asked, hold_of(rig, asked)))
    assert max(waited) * 10 / BAUD <= LONGEST_STRETCH_S, waited
    assert max(waited) > 0, "no stop came while the bus was busy: this shows nothing"


def hold_of(rig: Rig, asked: float) -> int:
    """The place in the log of the bytes that brought the hold."""
    wait_until(lambda: rig.goals(1, asked), "the hold is written")
    log = rig.log
    at = log.index(rig.goals(1, asked)[0])
    return max(place for place in range(at) if log[place].kind == "received")


def bytes_between(rig: Rig, asked: float, hold: int) -> int:
    return sum(len(entry.data) for entry in rig.log[:hold] if entry.kind in {"received", "sent"} and entry.t >= asked)
