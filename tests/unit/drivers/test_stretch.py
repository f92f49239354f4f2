"""S07: the longest stretch in which a bus thread cannot be interrupted, counted in bytes, so on any machine."""

import pytest

import trade_hil_sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Rig, call, written_now
from trade_drivers import parse

pytestmark = pytest.mark.virtual_time

BAUD, JOINTS = 57_600, 6
LONGEST_STRETCH_S = 0.020
"""Below the rule's 50 ms, so that a read of all joints in one piece, which takes 26 ms here, would show."""
ROUNDS = 8

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


@pytest.mark.parametrize("silent", [(), (5,)], ids=["all answer", "one is silent"])
def test_S07_a_stop_waits_for_no_more_bytes_than_20_ms_carry(rig: Rig, silent: tuple[int, ...]) -> None:
    rig.robot = parse(BUS + "".join(JOINT.format(id=i) for i in range(1, JOINTS + 1)), "many.toml")
    rig.plug(paced=True)
    first = rig.attach().motor("j1")
    with call(20.0):
        first.enable()
    if silent:
        rig.sim.do(trade_hil_sim.Mute(ids=silent))
    waited: list[int] = []
    for round_ in range(ROUNDS):
        first.set_velocity(0.9 if round_ % 2 else -0.9, 1.0)
        seen = len(reads(rig))
        wait_until(lambda seen=seen: len(reads(rig)) > seen, "a read has just begun")
        asked = written_now()
        first.stop()
        waited.append(bytes_between(rig, asked, hold_of(rig, asked)))
    assert max(waited) * 10 / BAUD <= LONGEST_STRETCH_S, waited
    assert max(waited) > 0, "no stop came while the bus was busy: this shows nothing"


def reads(rig: Rig) -> list[trade_hil_sim.LogEntry]:
    return trade_hil_sim.instructions(rig.log, "sync_read", device_id=JOINTS)


def hold_of(rig: Rig, asked: float) -> int:
    """The place in the log of the bytes that brought the hold."""
    wait_until(lambda: rig.goals(1, asked), "the hold is written")
    log = rig.log
    at = log.index(rig.goals(1, asked)[0])
    return max(place for place in range(at) if log[place].kind == "received")


def bytes_between(rig: Rig, asked: float, hold: int) -> int:
    return sum(len(entry.data) for entry in rig.log[:hold] if entry.kind in {"received", "sent"} and entry.t >= asked)
