"""The pure parts: packets, registers, scales, profiles."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import dynamixel_easy_sdk
import pytest
from dynamixel_sdk import Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st

import trade_drivers
from trade_drivers.joints._axis import Scale
from trade_drivers.joints._profile import Leg, together
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import CYCLIC, RESOLUTION, SLOW, DynamixelAxis
from trade_drivers.vendors.dynamixel._wire import Corrupt, crc16, take_status, unstuffed
from trade_hil_sim.dynamixel import status
from trade_robotfile import Joint

pytestmark = pytest.mark.virtual_time


def joint(**changes: object) -> Joint:
    values = {"id": 1, "min_rad": -1.0, "max_rad": 1.0, "max_speed_rad_s": 2.5, "max_accel_rad_s2": 20.0, **changes}
    return Joint(name="neck.pan", bus="neck", model="XL430-W250", **values)  # type: ignore[arg-type]


def test_the_crc_is_that_of_the_manual() -> None:
    assert crc16(b"123456789") == 0xFEE8
    assert crc16(bytes.fromhex("FFFFFD0001030001")) == 0x4E19


@given(st.binary(max_size=60))
def test_the_crc_is_that_of_the_vendor_library(data: bytes) -> None:
    assert crc16(data) == Protocol2PacketHandler().updateCRC(0, data, len(data))


@given(st.lists(st.binary(max_size=20), max_size=3), st.lists(st.binary(max_size=30), min_size=1, max_size=4))
def test_packets_are_found_between_noise_however_they_are_cut(noise: list[bytes], contents: list[bytes]) -> None:
    quiet = [part.replace(b"\xff", b"\xfe") for part in noise]
    packets = [status(7, 0, content) for content in contents]
    stream = b"".join((quiet[i] if i < len(quiet) else b"") + packet for i, packet in enumerate(packets))
    buffer, found = bytearray(), list[bytes]()
    for byte in stream:
        buffer.append(byte)
        if (frame := take_status(buffer)) is not None:
            found.append(unstuffed(frame)[9:-2])
    assert found == contents


@given(st.binary(max_size=200))
def test_no_noise_breaks_the_parser(data: bytes) -> None:
    buffer = bytearray(data)
    for _ in range(len(data) + 1):
        try:
            if take_status(buffer) is None:
                break
        except Corrupt:
            continue
    assert len(buffer) <= len(data)


def test_a_damaged_packet_is_taken_out_and_reported() -> None:
    whole = status(1, 0, b"\1\2\3")
    buffer = bytearray(whole[:-1] + bytes([whole[-1] ^ 1]) + whole)
    with pytest.raises(Corrupt):
        take_status(buffer)
    assert take_status(buffer) == whole


def test_an_echoed_instruction_is_no_answer() -> None:
    ping = bytes.fromhex("FFFFFD000103000119 4E")
    whole = status(1, 0, b"")
    assert take_status(bytearray(ping + whole)) == whole


def vendor_table(model: str) -> dict[str, tuple[int, int]]:
    """Name -> address and size, as the vendor library ships it."""
    folder = Path(next(iter(dynamixel_easy_sdk.__path__))) / "control_table"
    file = f"{model.lower().replace('-', '_')}{'_fw52' if '330-' in model else ''}.model"
    text = (folder / file).read_text()
    rows = [line.split("\t") for line in text.split("[control table]")[1].splitlines()[2:] if line.strip()]
    return {name.strip().lower(): (int(address), int(size)) for address, size, name in rows}


VENDOR_NAMES = {
    "ID": "ID",
    "BAUD": "Baud Rate",
    "FIRMWARE": "Firmware Version",
    "RETURN_DELAY": "Return Delay Time",
    "SHADOW_ID": "Secondary(Shadow) ID",
    "MAX_POSITION": "Max Position Limit",
    "MIN_POSITION": "Min Position Limit",
    "HARDWARE_ERROR": "Hardware Error Status",
    "INPUT_VOLTAGE": "Present Input Voltage",
    "TEMPERATURE": "Present Temperature",
}


@pytest.mark.parametrize("model", table.MODELS, ids=lambda model: model.name)
def test_the_registers_are_where_the_vendor_library_has_them(model: table.Model) -> None:
    theirs = vendor_table(model.name)
    registers = {name: value for name, value in vars(table).items() if isinstance(value, table.Register)}
    ours = {name: register for name, register in registers.items() if register.address != model.effort.address}
    ours["PRESENT_LOAD" if model.effort is table.PRESENT_LOAD else "PRESENT_CURRENT"] = model.effort
    for name, register in ours.items():
        assert (register.address, register.size) == theirs[VENDOR_NAMES.get(name, name.replace("_", " ")).lower()]


def test_the_models_are_those_of_the_simulator() -> None:
    import trade_hil_sim

    assert {model.name: (model.number, model.full_effort_counts) for model in table.MODELS} == {
        model.name: (model.number, model.full_effort_counts) for model in trade_hil_sim.MODELS.values()
    }


def test_the_registers_written_or_read_in_one_go_lie_side_by_side() -> None:
    for first, second in pairwise((table.PROFILE_ACCELERATION, table.PROFILE_VELOCITY, table.GOAL_POSITION)):
        assert first.end == second.address
    for first, second in pairwise((table.PRESENT_LOAD, table.PRESENT_VELOCITY, table.PRESENT_POSITION)):
        assert first.end == second.address
    assert CYCLIC == (126, 10)
    assert SLOW == (64, 83)


def test_counts_are_twos_complement_where_the_table_says_so() -> None:
    assert table.PRESENT_VELOCITY.decode(bytes.fromhex("fdffffff"), 128) == -3
    assert table.PROFILE_VELOCITY.decode(bytes.fromhex("fdffffff"), 112) == 4294967293
    with pytest.raises(OverflowError):
        table.PROFILE_VELOCITY.encode(-1)


@given(st.integers(0, 4095), st.booleans(), st.floats(-3, 3))
def test_counts_and_angles_convert_back_and_forth(counts: int, reversed_: bool, offset_rad: float) -> None:
    scale = Scale(joint(reversed=reversed_, offset_rad=offset_rad), RESOLUTION)
    assert scale.counts(scale.angle_rad(counts)) == pytest.approx(counts, abs=1e-6)


def test_the_range_of_a_joint_in_counts_holds_every_allowed_angle() -> None:
    for reversed_ in (False, True):
        axis = DynamixelAxis("rosie.neck.pan", "/dev/x", joint(reversed=reversed_, offset_rad=0.1))
        ends = sorted(round(axis.scale.counts(angle)) for angle in (-1.0, 1.0))
        assert axis.low <= ends[0] < ends[1] <= axis.high
        assert axis.high - axis.low <= ends[1] - ends[0] + 2


LEGS = st.builds(Leg, st.integers(0, 4000), st.integers(1, 300), st.integers(1, 200), st.just(RESOLUTION))


@given(st.lists(LEGS, min_size=1, max_size=6))
def test_no_profile_exceeds_the_limits_of_its_joint_nor_means_no_limit(legs: list[Leg]) -> None:
    for leg, profile in zip(legs, together(legs), strict=True):
        assert 1 <= profile.speed_counts <= leg.speed_counts
        assert 1 <= profile.accel_counts <= leg.accel_counts


@given(
    st.lists(
        st.builds(Leg, st.integers(300, 2000), st.just(104), st.just(53), st.just(RESOLUTION)), min_size=2, max_size=6
    )
)
def test_joints_arrive_together(legs: list[Leg]) -> None:
    durations = [profile.duration_s for profile in together(legs)]
    assert max(durations) < 1.1 * min(durations)


def test_a_joint_alone_uses_its_limits() -> None:
    (profile,) = together([Leg(2000, 104, 53, RESOLUTION)])
    assert profile[:2] == (53, 104)


def test_the_public_names_exist() -> None:
    assert len(trade_drivers.__all__) == len(set(trade_drivers.__all__))
    for name in trade_drivers.__all__:
        assert getattr(trade_drivers, name).__doc__


@pytest.mark.realtime
def test_no_vendor_library_is_imported_before_a_bus_is_attached() -> None:
    imports = "import sys, trade_drivers, trade_drivers.vendors.dynamixel"
    code = f"{imports}; print({{'serial', 'dynamixel_sdk'}} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"
