"""The frames of ODrives and Damiao motors against other people's: odrive-can's DBC, damiao-motor's codec."""

import struct
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade_drivers.vendors.damiao import _frames as damiao
from trade_drivers.vendors.damiao import _table as table
from trade_drivers.vendors.odrive import _frames as odrive
from trade_drivers.vendors.odrive._frames import frame_id
from trade_drivers.vendors.odrive._table import Command, Control, Errors, Input, State
from trade_hil_sim.damiao import MODELS, Ranges, decode_mit, encode_feedback
from trade_hil_sim.damiao import Register as SimRegister
from trade_hil_sim.damiao import Status as SimStatus
from trade_hil_sim.odrive import Command as SimCommand

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
turns = st.floats(-1000, 1000, width=32)


@pytest.fixture(scope="module")
def dbc() -> Any:
    if sys.version_info < (3, 11):
        pytest.skip("odrive-can needs Python 3.11")
    from odrive_can.utils import get_dbc

    return get_dbc()


@pytest.mark.parametrize(
    ("command", "data", "signals"),
    [
        (Command.SET_STATE, odrive.set_state(State.CLOSED_LOOP), {"Axis_Requested_State": "CLOSED_LOOP_CONTROL"}),
        (
            Command.SET_MODE,
            odrive.set_mode(Control.POSITION, Input.TRAJECTORY),
            {"Control_Mode": "POSITION_CONTROL", "Input_Mode": "TRAP_TRAJ"},
        ),
        (Command.SET_POSITION, odrive.set_position(2.5), {"Input_Pos": 2.5, "Vel_FF": 0, "Torque_FF": 0}),
        (Command.SET_VELOCITY, odrive.set_velocity(-0.5), {"Input_Vel": -0.5, "Input_Torque_FF": 0}),
        (Command.SET_TRAJECTORY_SPEED, odrive.set_trajectory_speed(3.5), {"Traj_Vel_Limit": 3.5}),
        (
            Command.SET_TRAJECTORY_ACCEL,
            odrive.set_trajectory_accel(1.5),
            {"Traj_Accel_Limit": 1.5, "Traj_Decel_Limit": 1.5},
        ),
    ],
    ids=lambda value: value.name if isinstance(value, Command) else "",
)
def test_an_odrive_gets_the_commands_that_the_dbc_of_odrive_can_defines(
    dbc: Any, command: Command, data: bytes, signals: dict[str, object]
) -> None:
    message = dbc.get_message_by_frame_id(frame_id(1, command))
    reported = message.decode(data.ljust(message.length, b"\0"))
    assert {
        name: str(value) if isinstance(signals[name], str) else value for name, value in reported.items()
    } == signals


def test_a_heartbeat_of_odrive_cans_dbc_is_understood(dbc: Any) -> None:
    message = dbc.get_message_by_name("Axis1_Heartbeat")
    data = message.encode({signal.name: 0 for signal in message.signals} | {"Axis_State": 8, "Axis_Error": 0x1000000})
    beat = odrive.Heartbeat.decode(data)
    assert (beat.state, beat.errors.text) == (8, "watchdog")
    assert message.frame_id == frame_id(1, Command.HEARTBEAT)


def test_driver_and_simulator_agree_on_the_numbers_of_commands() -> None:
    assert {int(command) for command in Command} <= {int(command) for command in SimCommand}


@pytest.mark.parametrize(
    ("errors", "text"),
    [(0x1000000, "watchdog"), (0x300, "over voltage, under voltage"), (0x80000000, "80000000h"), (0, "")],
)
def test_errors_are_explained_in_words(errors: int, text: str) -> None:
    assert Errors(errors).text == text


@given(data=st.binary(max_size=8))
def test_no_bytes_confuse_an_odrives_decoders(data: bytes) -> None:
    for decode in (odrive.Heartbeat.decode, odrive.Health.decode, odrive.Version.decode, odrive.two_floats):
        try:
            decode(data)
        except struct.error:
            assert len(data) != 8


def test_driver_and_simulator_agree_on_models_registers_and_status() -> None:
    assert {name: tuple(ranges) for name, ranges in table.MODELS.items()} == {n: tuple(r) for n, r in MODELS.items()}
    assert {(r.name, r.value) for r in table.Register} <= {(r.name, r.value) for r in SimRegister}
    assert {(s.name, s.value) for s in table.Status} == {(s.name, s.value) for s in SimStatus}


def test_the_known_vector_of_a_mit_command() -> None:
    reported = decode_mit(bytes.fromhex("8A3C8210A3333832"), MODELS["DM4310"])
    assert reported == pytest.approx((0.9997, 0.4908, 19.902, 1.0, 0.2466), abs=5e-4)


@given(
    position=st.floats(-12.5, 12.5),
    velocity=st.floats(-30, 30),
    torque=st.floats(-10, 10),
    status=st.integers(0, 15),
    number=st.integers(1, 15),
)
def test_feedback_is_read_as_it_was_written(
    position: float, velocity: float, torque: float, status: int, number: int
) -> None:
    ranges = MODELS["DM4310"]
    data = encode_feedback(status, number, (position, velocity, torque), ranges, (30, 41))
    reported = damiao.Feedback.decode(data, table.MODELS["DM4310"])
    assert (reported.status, reported.nibble, reported.temperature_c) == (status, number, 41)
    assert reported.position_rad == pytest.approx(position, abs=25 / 65535)
    assert reported.velocity_rad_s == pytest.approx(velocity, abs=60 / 4095)
    assert reported.torque_nm == pytest.approx(torque, abs=20 / 4095)


@given(data=st.binary(max_size=8))
def test_no_bytes_confuse_a_damiaos_decoders(data: bytes) -> None:
    for register in table.Register:
        damiao.answer(data, 1, register)
    try:
        damiao.Feedback.decode(data, table.MODELS["DM4310"])
    except struct.error:
        assert len(data) != 8


def test_the_ranges_are_those_of_damiao_motor() -> None:
    from damiao_motor.core.motor import MOTOR_TYPE_PRESETS

    for name, preset in MOTOR_TYPE_PRESETS.items():
        ours = Ranges(*(max(preset[key] for key in preset if key.lower().startswith(letter)) for letter in "pvt"))
        assert MODELS[f"DM{name}"] == ours, name
