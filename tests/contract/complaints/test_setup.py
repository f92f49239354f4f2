"""Complaints of other projects about calibrating a robot, starting it with its computer, and its adapters."""

import time
from math import tau
from pathlib import Path
from typing import Any

import pytest

from tests.contract.complaints import setup_mutants as mutants
from tests.contract.complaints.bodies import outcome
from tests.contract.complaints.table import complaint
from tests.unit.gateway.test_calibrate import Hand, angles, done_after
from tests.unit.gateway.test_doctor_brltty import Host
from tests.unit.gateway.test_life import launched, life
from tests.unit.trade.test_addresses import GOOD, VPN, Wire, as_written
from trade.transport.addresses import Attempts
from trade_drivers import Joint
from trade_gateway.cli.hardware._calibrate import Sweep, TravelEnds, measured
from trade_gateway.supervisor._restart_policy import State

JOINT = Joint(
    name="arm.wrist", bus="arm", id=4, model="STS3215", min_rad=-1, max_rad=1, max_speed_rad_s=1, max_accel_rad_s2=10
)


def swept(*counts: int) -> TravelEnds:
    """What a sweep by hand over these positions measures, in counts."""
    bench: Any = Hand(angles(*counts))
    return Sweep(bench, JOINT.id, JOINT.name).until(done_after(len(counts) - 1), 60.0)


@complaint(("folder", mutants.a_range_is_the_least_and_the_greatest_reading, "is 4095 counts wide, not 396"))
def test_a_range_across_the_end_of_the_encoder(_: Path) -> None:
    ends = swept(3900, 4095, 0, 200)
    wide = round((ends.high - ends.low) * 4096 / tau)
    assert wide == 396, f"the range is {wide} counts wide, not 396"
    assert "0.607 rad wide, but passes the end of its encoder" in outcome(lambda: measured(JOINT, None, ends))
    assert set(measured(JOINT, None, swept(1000, 2048, 3000))) == {"min_rad", "max_rad"}


@complaint(("folder", mutants.a_start_without_its_device_is_a_crash, "given up before its motors had power"))
def test_motors_get_power_later_than_the_computer(_: Path) -> None:
    child, now = life(restarts=10, window_s=300.0), 0.0
    child.start(now)
    while now < 3600:
        now = launched(child, now) + 1
        child.ended(now, "ended (exit code 75: DeviceAbsent)", absent=True)
        assert child.state is State.WAITING, "given up before its motors had power"
    launched(child, now)
    child.up(now + 31)
    assert child.state is State.UP
    for _crash in range(11):
        child.ended(now + 32, "crashed (signal 11)")
        if child.state is State.WAITING:
            launched(child, now)
    assert child.state is State.GIVEN_UP


@complaint(("folder", mutants.no_rule_of_udev_is_read, "nothing says that brltty has the adapter"))
def test_brltty_takes_the_adapter_away(folder: Path) -> None:
    host = Host(folder)
    host.plug("1a86:7523")
    said = [found.text for found in host.check()]
    assert any(str(host.rules) in text for text in said), "nothing says that brltty has the adapter"
    host.rules.write_text("")
    assert not host.check()


@pytest.mark.virtual_time
@complaint(("folder", mutants.addresses_are_tried_one_after_the_other, "the good address is tried after 24 s"))
def test_dead_addresses_delay_a_connection(_: Path) -> None:
    tried = Attempts(resolve=as_written, knocks=Wire(**{"10_9_0_5": (0.01, "")}).knock)
    began = time.monotonic()
    assert next(tried.accepting([*VPN, GOOD])) == GOOD
    took_s = time.monotonic() - began
    assert took_s < 5, f"the good address is tried after {took_s:.0f} s"
    assert next(tried.accepting([GOOD])) == GOOD  # the control
