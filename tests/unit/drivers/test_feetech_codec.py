"""The packets and registers of Feetech servos as the driver reads and writes them; vectors taken off the wire."""

import subprocess
import sys
from collections.abc import Sequence
from types import SimpleNamespace

import hypothesis
import pytest
import rustypot
from hypothesis import strategies as st

from trade_drivers.joints import Goal, Sample
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import CYCLIC, SLOW, FeetechAxis
from trade_drivers.vendors.feetech._exchange import GOAL_BLOCK, goal_block
from trade_drivers.vendors.feetech._wire import Corrupt, Status, checksum, packet, take_status
from trade_hil_sim.feetech import STS3215, PacketReader, encode, status
from trade_robotfile import Joint

pytestmark = pytest.mark.virtual_time

REGISTERS = {name: value for name, value in vars(table).items() if isinstance(value, table.Register)}
IDS = (1, 2, 3)
BLIND_NS = 300_000_000


def taken(data: bytes, size: int, ids: Sequence[int] = IDS) -> list[Status]:
    buffer, found = bytearray(data), list[Status]()
    while True:
        try:
            if (one := take_status(buffer, ids, size)) is None:
                return found
        except Corrupt:
            continue
        found.append(one)


@pytest.mark.parametrize(
    ("made", "wire"),
    [
        (packet(1, 0x01), "ff ff 01 02 01 fb"),
        (packet(1, 0x08), "ff ff 01 02 08 f4"),
        (packet(1, 0x03, bytes.fromhex("2ae803")), "ff ff 01 05 03 2a e8 03 e1"),
    ],
    ids=["ping", "reboot", "write goal 1000"],
)
def test_packets_are_as_other_clients_send_them(made: bytes, wire: str) -> None:
    assert made == bytes.fromhex(wire)


def test_an_answer_without_data_is_read() -> None:
    assert taken(bytes.fromhex("ffff010200fc"), 0) == [Status(1, 0, b"")]


@hypothesis.given(st.binary(max_size=6), st.binary(min_size=6, max_size=6), st.integers(0, 63))
def test_driver_and_simulator_understand_each_other_in_spite_of_noise(noise: bytes, data: bytes, bits: int) -> None:
    hypothesis.assume(b"\xff" not in noise[-1:])  # else the header begins a byte early
    assert Status(2, bits, data) in taken(noise + status(2, bits, data) + status(3, 0, data), 6)
    [read] = [one for one in PacketReader().feed(noise + packet(2, 0x03, data)) if one.instruction == 0x03]
    assert (read.device_id, read.params) == (2, data)


@hypothesis.given(st.binary(max_size=60), st.integers(0, 12))
def test_no_bytes_stop_it_and_none_is_read_twice(data: bytes, size: int) -> None:
    assert len(taken(data, size, range(254))) <= len(data) // (6 + size)


@pytest.mark.parametrize("ff", [b"\xff", b"\xff\xff", b"\xff\xff\xff"])
def test_a_header_with_more_bytes_of_its_kind_before_it_is_found(ff: bytes) -> None:
    assert taken(ff + status(1, 0, b"\1\2"), 2) == [Status(1, 0, b"\1\2")]


def test_an_answer_of_another_length_or_id_is_none() -> None:
    others = status(1, 0, b"\1\2\3") + status(4, 0, b"\1\2") + encode(0xFE, 0x82, bytes((56, 6, 1)))
    assert taken(others + status(1, 0, b"\5\6"), 2) == [Status(1, 0, b"\5\6")]


def test_what_was_sent_itself_is_no_answer() -> None:
    asked = packet(1, 0x02, bytes((3, 2)))
    buffer = bytearray(asked + status(1, 0, b"\x09\x03"))
    assert take_status(buffer, (1,), 2, asked) == Status(1, 0, b"\x09\x03")


def test_a_damaged_answer_is_reported_and_the_next_one_read() -> None:
    whole = status(1, 0, b"\1\2")
    buffer = bytearray(whole[:-1] + b"\0" + whole)
    with pytest.raises(Corrupt):
        take_status(buffer, IDS, 2)
    assert take_status(buffer, IDS, 2) == Status(1, 0, b"\1\2")


@pytest.mark.parametrize(
    "late",
    [
        b"",
        b"\x07",
        bytes((9, 3, checksum(bytes((1, 6, 0, 9, 3))), 5)),  # its first eight bytes look like an answer of two
        b"\1\2\3\xff\xff\4",
    ],
)
def test_a_whole_answer_of_another_length_is_passed_over_and_damages_nothing(late: bytes) -> None:
    buffer = bytearray(status(1, 0, late) + status(1, 0, b"\1\2"))
    assert take_status(buffer, IDS, 2) == Status(1, 0, b"\1\2")
    assert not buffer


@pytest.mark.parametrize("cut", range(1, 8))
def test_half_an_answer_waits_for_its_other_half(cut: int) -> None:
    whole = status(1, 0, b"\1\2")
    buffer = bytearray(whole[:cut])
    assert take_status(buffer, IDS, 2) is None
    buffer += whole[cut:]
    assert take_status(buffer, IDS, 2) == Status(1, 0, b"\1\2")


@pytest.mark.parametrize(
    ("register", "counts", "raw"),
    [
        (table.PRESENT_POSITION, -100, 0x8064),
        (table.PRESENT_LOAD, -100, 0x0464),
        (table.PRESENT_SPEED, 100, 0x0064),
        (table.GOAL_POSITION, 4095, 0x0FFF),
    ],
)
def test_numbers_are_sign_and_magnitude(register: table.Register, counts: int, raw: int) -> None:
    assert register.encode(counts) == raw.to_bytes(2, "little")
    assert register.decode(raw.to_bytes(2, "little"), register.address) == counts


@pytest.mark.parametrize(("register", "counts"), [(table.TORQUE, -1), (table.TORQUE, 256), (table.GOAL_SPEED, 1 << 15)])
def test_what_does_not_fit_is_no_register_value(register: table.Register, counts: int) -> None:
    with pytest.raises(OverflowError):
        register.encode(counts)


@pytest.mark.parametrize("name", REGISTERS)
def test_an_independent_client_and_the_simulator_have_the_same_register(name: str) -> None:
    ours = REGISTERS[name]
    simulated = {register.address: register for register in STS3215.registers}[ours.address]
    assert (simulated.size, simulated.sign_bit) == (ours.size, ours.sign_bit) or name == "GOAL_TIME"
    assert simulated.writable == (ours.access is not table.Access.READ)
    assert simulated.eeprom == (ours.access is table.Access.EEPROM) or not simulated.writable
    theirs = {register.addr: register for register in rustypot.Sts3215PyController.registers()}
    if name not in ("END", "WRITE_FLAG"):  # it does not know these
        assert theirs[ours.address].size == ours.size
        assert (theirs[ours.address].access == rustypot.RegisterAccess.Read) == (not simulated.writable)


def test_what_is_read_and_written_together_lies_together() -> None:
    assert (CYCLIC, SLOW, GOAL_BLOCK) == ((56, 6), (40, 27), (41, 7))
    goal = Goal(-100, 20, 15)
    assert goal_block(goal) == bytes((20, 0x64, 0x80, 0, 0)) + (150).to_bytes(2, "little")


def joint(**changes: object) -> Joint:
    limits = {"min_rad": -1.4, "max_rad": 1.4, "max_speed_rad_s": 2.5, "max_accel_rad_s2": 20.0}
    return Joint(name="a", bus="b", id=1, model="STS3215", **limits | changes)  # type: ignore[arg-type]


@hypothesis.given(st.integers(0, 4095), st.integers(0, 4095), st.integers(1, 200), st.integers(1, 160))
def test_a_step_leads_towards_the_aim_and_far_enough_to_keep_its_speed(
    here: int, there: int, accel: int, speed: int
) -> None:
    axis = FeetechAxis("rosie.a", "/dev/x", joint(), 0.3)
    axis.note(Sample(here, 0, 0, 0), 0)
    step = axis.step(Goal(there, accel, speed), 0)
    assert (step.accel, step.speed) == (accel, speed)
    assert min(here, there) <= step.position <= max(here, there)
    if step.position != there:
        assert abs(step.position - here) >= (10 * speed) ** 2 / (2 * 100 * accel) + 10 * speed * 0.3 - 1


@pytest.mark.parametrize(("passed_s", "hold"), [(0.1, 2200), (0.42, 2200), (0.43, None), (9.0, None)])
def test_an_unheard_joint_gets_hold_commands_until_it_surely_rests_by_itself(passed_s: float, hold: int | None) -> None:
    axis = FeetechAxis("rosie.a", "/dev/x", joint(), 0.3)
    axis.note(Sample(2200, 160, 0, 10**9), 10**9)
    axis.sent_ns = 10**9 + 1
    assert axis.hold_counts(axis.sent_ns + int(passed_s * 1e9), BLIND_NS) == hold
    axis.note(Sample(2300, 0, 0, axis.sent_ns + 1), axis.sent_ns + 1)
    assert axis.hold_counts(axis.sent_ns + 10**10, BLIND_NS) == 2300


def test_a_joint_unheard_on_its_way_gets_no_hold_beyond_its_last_goal() -> None:
    axis = FeetechAxis("rosie.a", "/dev/x", joint(), 0.3)
    axis.note(Sample(2200, 160, 0, 10**9), 10**9)
    axis.motion = SimpleNamespace(goal_of=lambda _: 4000)  # type: ignore[assignment]
    axis.sent, axis.sent_ns = 2300, 10**9 + 1
    assert axis.hold_counts(10**9 + 60_000_000, BLIND_NS) == 2296  # where it must have got to
    assert axis.hold_counts(10**9 + 200_000_000, BLIND_NS) == 2300


@pytest.mark.realtime
def test_importing_the_driver_needs_no_serial_library() -> None:
    code = "import sys, trade_drivers, trade_drivers.vendors.feetech; print({'serial'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"
