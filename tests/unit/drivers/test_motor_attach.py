"""What ODrives and Damiao motors are refused for, and what an ODrive's watchdog has to show."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import can
import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import written_now
from tests.unit.drivers.motor_rig import KINDS, ROOT, TIP, MotorRig, motor_rig, wag
from trade.errors import ConfigurationError, DeviceFault
from trade_drivers import load
from trade_drivers.vendors.odrive import _frames as frames
from trade_drivers.vendors.odrive._frames import frame_id
from trade_drivers.vendors.odrive._table import Command, Control, Input, State

pytestmark = pytest.mark.virtual_time

__all__ = ["motor_rig", "wag"]


@pytest.fixture
def odrives() -> Iterator[MotorRig]:
    with ExitStack() as undo:
        yield KINDS["odrive"](undo)


@pytest.fixture
def damiaos() -> Iterator[MotorRig]:
    with ExitStack() as undo:
        yield KINDS["damiao"](undo)


def send(bus: can.BusABC, node: int, command: Command, data: bytes) -> None:
    bus.send(can.Message(arbitration_id=frame_id(node, command), data=data, is_extended_id=False))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('leave = "relax"', 'leave = "hold"'), "lets go"),
        (('model = "ODrive S1"', 'model = "ODrive S1"\ncounts_per_rev = 4096'), "turns, not counts"),
        (('model = "ODrive S1"', 'model = "ODrive S1"\nhoming_counts = 7'), "is for servos"),
        (('model = "ODrive S1"', 'model = "ODrive v3.6"'), "is not one of"),
        (('model = "ODrive S1"', 'model = "ODrive S1"\nserial_number = 7'), "no serial number here"),
        (("id = 2", "id = 63"), "is no node"),
        (("watchdog_s = 0.4", "watchdog_s = 0.6"), "enable.. waits"),
        (("watchdog_s = 0.4", "watchdog_s = 0.4\nrate_hz = 5"), "too slow"),
        (("watchdog_s = 0.4", "watchdog_s = 0.4\nbitrate = 50000"), "at most"),
        (("max_accel_rad_s2 = 20.0", "max_accel_rad_s2 = 1.0"), "a stop from"),
    ],
)
def test_an_odrive_is_refused_for_what_the_file_says(odrives: MotorRig, change: tuple[str, str], says: str) -> None:
    odrives.plug()
    odrives.configure(change)
    with pytest.raises(ConfigurationError, match=says):
        odrives.attach()
    assert not [e for e in odrives.frames() if e.direction == "in"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('model = "DM4310"', 'model = "DM1"'), "is not one of"),
        (('model = "DM4310"', 'model = "DM4310"\nhoming_counts = 7'), "is for servos"),
        (('model = "DM4310"', 'model = "DM4310"\nserial_number = 7'), "no serial number here"),
        (("id = 2", "id = 16"), "1 to 15"),
        (("max_rad = 1.0", "max_rad = 12.4"), "farther from its zero"),
        (("max_speed_rad_s = 2.0", "max_speed_rad_s = 31.0"), "the most a DM4310 reports"),
        (("watchdog_s = 0.4", "watchdog_s = 0.4\nbitrate = 10000"), "at most"),
    ],
)
def test_a_damiao_is_refused_for_what_the_file_says(damiaos: MotorRig, change: tuple[str, str], says: str) -> None:
    damiaos.plug()
    damiaos.configure(change)
    with pytest.raises(ConfigurationError, match=says):
        damiaos.attach()
    assert not [e for e in damiaos.frames() if e.direction == "in"]


def test_an_odrive_without_a_watchdog_is_not_enabled(odrives: MotorRig) -> None:
    odrives.plug(prepare=lambda bus: setattr(bus.devices[0], "watchdog_s", None))
    root = odrives.attach().motor("tail.root")
    with pytest.raises(DeviceFault, match="enable_watchdog"):
        root.enable()
    wait_until(lambda: not odrives.truth(ROOT).torque, "it has let go")
    assert not odrives.targets(ROOT)
    assert not odrives.events("motion_started")


def test_an_odrive_shows_its_watchdog_once_without_torque_and_only_then_holds(odrives: MotorRig) -> None:
    odrives.plug()
    root = odrives.attach().motor("tail.root")
    mark = written_now()
    root.enable()
    expired = odrives.wait_for("watchdog_expired", ROOT, mark)
    before = [e for e in odrives.commanded(ROOT, mark) if e.t < expired.t]
    assert [e.name for e in before] == ["set_controller_mode", "set_input_torque", "set_axis_state"]
    assert before[1].data == bytes(4)
    root.relax()
    again = written_now()
    root.enable()
    assert not odrives.events("watchdog_expired", ROOT, again)


def test_S18_an_odrive_found_moving_is_stopped_and_refused(odrives: MotorRig) -> None:
    odrives.plug(prepare=lambda bus: setattr(bus.devices[0], "watchdog_s", None))
    with odrives.listen() as other:
        send(other, ROOT, Command.SET_MODE, frames.set_mode(Control.VELOCITY, Input.PASSTHROUGH))
        send(other, ROOT, Command.SET_VELOCITY, frames.set_velocity(0.3))
        send(other, ROOT, Command.SET_STATE, frames.set_state(State.CLOSED_LOOP))
        began = odrives.wait_for("motion_started", ROOT)
    with pytest.raises(ConfigurationError, match="enable_watchdog"):
        odrives.attach()
    odrives.wait_for("at_rest", ROOT, began.t)
    assert odrives.truth(ROOT).torque
    assert not odrives.targets(ROOT)


def test_a_damiao_is_watched_from_attaching_on(damiaos: MotorRig) -> None:
    damiaos.plug()
    damiaos.attach()
    for joint in (ROOT, TIP):
        assert damiaos.truth(joint).watchdog == 8000  # 0.4 s in steps of 50 us


def test_the_example_of_a_tail_moves_on_the_simulator(odrives: MotorRig) -> None:
    odrives.robot = load(Path(__file__).parents[3] / "examples" / "tail.toml")
    odrives.plug()
    assert odrives.attach().group("tail").move_to([0.3, -0.3]) == pytest.approx([0.3, -0.3], abs=0.01)
