"""Other people's clients on the simulated motors: odrive-can and damiao-motor, unmodified, over socketcand."""

import asyncio
import struct
import sys
import time
from collections.abc import Iterator
from typing import Any

import can
import pytest

from tests.support.waiting import wait_until
from trade_hil_sim import events, frames
from trade_hil_sim.damiao import DamiaoBus, Motor
from trade_hil_sim.odrive import Axis, Control, OdriveBus

pytestmark = [pytest.mark.realtime, pytest.mark.filterwarnings("ignore")]
NODE = 1


def client(bus: OdriveBus | DamiaoBus) -> can.BusABC:
    address, _, channel = bus.port.removeprefix("socketcand:").partition("/")
    host, _, port = address.partition(":")
    return can.Bus(interface="socketcand", host=host, port=int(port), channel=channel, tcp_tune=True)


@pytest.fixture
def odrive() -> Iterator[OdriveBus]:
    with OdriveBus([Axis(NODE, watchdog_s=None, t=time.monotonic())], paced=False) as bus:
        yield bus


def with_odrive_can(bus: OdriveBus, act: Any) -> None:
    if sys.version_info < (3, 11):
        pytest.skip("odrive-can needs Python 3.11")
    from odrive_can.odrive import ODriveCAN

    async def run() -> None:
        drive = ODriveCAN(axis_id=NODE, can_bus=client(bus))
        await asyncio.wait_for(drive.start(), 10)
        try:
            await act(drive)
        finally:
            drive.stop()

    asyncio.run(run())


async def shows(drive: Any, state: str) -> None:
    async def seen() -> None:
        while drive.axis_state != state:
            await drive.wait_for_heartbeat()

    await asyncio.wait_for(seen(), 10)


def test_odrive_can_moves_a_simulated_axis(odrive: OdriveBus) -> None:
    async def act(drive: Any) -> None:
        drive.clear_errors()
        drive.set_controller_mode("POSITION_CONTROL", "PASSTHROUGH")
        await drive.set_axis_state("CLOSED_LOOP_CONTROL")
        await shows(drive, "CLOSED_LOOP_CONTROL")
        drive.check_errors()
        drive.set_input_pos(2.5)
        await asyncio.to_thread(wait_until, lambda: events(list(odrive.log.entries), "at_rest"), "it has arrived")

    with_odrive_can(odrive, act)
    [truth] = odrive.state().devices
    assert (truth.position_counts, truth.operating_mode) == (2500, Control.POSITION)


def test_odrive_can_sees_an_unfed_axis_relax() -> None:
    with OdriveBus([Axis(NODE, watchdog_s=0.2, t=time.monotonic())], paced=False) as bus:

        async def act(drive: Any) -> None:
            drive.set_controller_mode("TORQUE_CONTROL", "PASSTHROUGH")
            await drive.set_axis_state("CLOSED_LOOP_CONTROL")
            await asyncio.to_thread(
                wait_until, lambda: events(list(bus.log.entries), "watchdog_expired"), "its watchdog expires"
            )
            await shows(drive, "IDLE")
            from odrive_can.odrive import DriveError

            with pytest.raises(DriveError, match="WATCHDOG"):
                drive.check_errors()

        with_odrive_can(bus, act)


def test_a_question_without_data_is_answered_as_a_remote_frame_is(odrive: OdriveBus) -> None:
    with client(odrive) as asker:
        for remote in (False, True):
            asker.send(can.Message(arbitration_id=NODE << 5, is_extended_id=False, is_remote_frame=remote, dlc=0))
        wait_until(lambda: len(frames(list(odrive.log.entries), "get_version", direction="out")) >= 1, "it answers")
    [asked, *_] = frames(list(odrive.log.entries), "ask_get_version")
    assert asked.device_id == NODE


@pytest.mark.parametrize("turns", [float("inf"), float("-inf"), float("nan")])
def test_an_order_that_is_infinite_or_no_number_is_refused(odrive: OdriveBus, turns: float) -> None:
    with client(odrive) as asker:
        data = struct.pack("<fhh", turns, 0, 0)
        asker.send(can.Message(arbitration_id=NODE << 5 | 0x0C, is_extended_id=False, data=data))
        wait_until(lambda: bool(events(list(odrive.log.entries), "refused")), "it is refused")
    [truth] = odrive.state().devices
    assert truth.goal_counts == truth.position_counts


@pytest.fixture
def damiao() -> Iterator[DamiaoBus]:
    with DamiaoBus([Motor(NODE, t=time.monotonic())], paced=False) as bus:
        yield bus


@pytest.fixture
def controller(damiao: DamiaoBus, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    from damiao_motor.core.controller import DaMiaoController

    made = can.interface.Bus
    monkeypatch.setattr(can.interface, "Bus", lambda channel, bustype: client(damiao))
    controller = DaMiaoController(channel="unused")
    monkeypatch.setattr(can.interface, "Bus", made)
    yield controller
    controller.shutdown()


@pytest.fixture
def motor(controller: Any) -> Any:
    return controller.add_motor(motor_id=NODE, feedback_id=NODE + 16, motor_type="4310")


def test_damiao_motor_reads_the_ranges_of_a_simulated_motor(motor: Any) -> None:
    assert [motor.get_register(number) for number in (21, 22, 23)] == [12.5, 30.0, 10.0]
    assert motor.get_register(8) == NODE


def test_damiao_motor_moves_a_simulated_motor_by_springs_and_by_positions(damiao: DamiaoBus, motor: Any) -> None:
    motor.enable()
    wait_until(lambda: damiao.state().devices[0].torque, "it is enabled")

    def at(goal: float) -> bool:
        motor.send_cmd_mit(target_position=goal, target_velocity=0.0, stiffness=20.0, damping=1.0, feedforward_torque=0)
        return bool(abs(motor.get_states().get("pos", 9.0) - goal) < 2e-3)

    wait_until(lambda: at(1.0), "the spring has pulled it there")
    motor.write_register(10, 2)
    motor.registers.pop(10, None)
    wait_until(lambda: damiao.state().devices[0].operating_mode == 2, "it is in the other mode")
    motor.send_cmd_pos_vel(target_position=-0.5, velocity_limit=2.0)
    wait_until(lambda: abs(damiao.state().devices[0].position_rad + 0.5) < 1e-3, "it has arrived")


def test_damiao_motor_sees_a_motor_that_hears_nothing_relax(damiao: DamiaoBus, motor: Any) -> None:
    motor.set_can_timeout(100)
    motor.enable()
    wait_until(lambda: events(list(damiao.log.entries), "watchdog_expired"), "its time-out has come")
    motor.request_motor_feedback()
    wait_until(lambda: motor.get_states().get("status_code") == 0xD, "it says so")
