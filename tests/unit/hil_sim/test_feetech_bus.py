"""The simulated Feetech bus, driven by a client that shares no code with it or with our driver: rustypot."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
import rustypot
import serial

import trade_hil_sim as sim
from tests.support.simulated_robots import TAIL
from tests.support.waiting import wait_until
from trade_hil_sim import SimProcess, events, motion_writes, writes
from trade_hil_sim.feetech import FeetechBus, PacketReader, Servo, encode, status

pytestmark = pytest.mark.realtime


@pytest.fixture
def make_bus(tmp_path: Path) -> Iterator[Callable[..., FeetechBus]]:
    with ExitStack() as undo:

        def make(*ids: int, **options: Any) -> FeetechBus:
            port = tmp_path / f"bus{len(list(tmp_path.iterdir()))}"
            return undo.enter_context(FeetechBus([Servo(i, **options) for i in ids], port, paced=False))

        yield make


@pytest.fixture
def bus(make_bus: Callable[..., FeetechBus]) -> FeetechBus:
    """Servos 1, 2 and 3."""
    return make_bus(1, 2, 3)


@pytest.fixture
def client(bus: FeetechBus) -> Iterator[Any]:
    with closing(rustypot.Sts3215PyController(str(bus.port), 1_000_000, 2.0)) as made:
        yield made


def test_ping_scan_read_write(client: Any, bus: FeetechBus) -> None:
    assert client.ping(1)
    assert set(client.scan([1, 2, 3])) == {1, 2, 3}
    assert client.read_raw_present_position(1) == [2048]
    client.write_raw_goal_position(2, 1000)
    assert client.read_raw_goal_position(2) == [1000]
    [written] = writes(bus.log.entries)
    assert (written.device_id, written.registers, written.moves) == (2, ("goal_position",), True)


def test_sync_read_and_sync_write_move_what_has_torque(client: Any, bus: FeetechBus) -> None:
    for servo in bus.devices:
        servo.goal_switches_on = False
    client.write_torque_enable(1, True)
    client.write_torque_enable(3, True)
    client.sync_write_raw_goal_position([1, 2, 3], [2101, 2102, 2103])
    wait_until(lambda: client.sync_read_raw_present_position([3, 1, 2]) == [2103, 2101, 2048], "they arrived")
    assert {entry.device_id for entry in events(bus.log.entries, "motion_started")} == {1, 3}
    assert [e.device_id for e in motion_writes(bus.log.entries) if e.name == "sync_write"] == [1, 2, 3]


def test_negative_values_are_what_the_client_takes_them_for(client: Any, bus: FeetechBus) -> None:
    bus.do(sim.Place(ids=(1,), counts=-100))
    assert client.read_register(1, "present_position") == -100
    client.write_register(1, "homing_offset", -85)
    assert client.read_register(1, "homing_offset") == -85


def test_the_client_receives_the_error_bits_of_a_servo(client: Any, bus: FeetechBus) -> None:
    bus.do(sim.HardwareFault(ids=(1,), bits=0x20))
    assert client.read_status(1) == [0x20]
    assert client.read_status(2) == [0]


def test_the_lock_decides_what_survives_a_reboot(client: Any, bus: FeetechBus) -> None:
    client.write_p_coefficient(1, 50)
    client.write_lock(2, False)
    client.write_p_coefficient(2, 60)
    for device_id in (1, 2):
        client.reboot(device_id)
    wait_until(lambda: len(events(bus.log.entries, "booted")) == 2, "they have booted")
    assert (client.read_p_coefficient(1), client.read_p_coefficient(2)) == ([32], [60])


def test_a_new_id_is_answered_under_the_old_one(bus: FeetechBus) -> None:
    assert talk(bus, encode(1, 3, bytes((5, 9)))) == status(1, 0)
    assert talk(bus, encode(9, 1)) == status(9, 0)


def test_an_absent_id_in_a_sync_read_spoils_it(client: Any) -> None:
    with pytest.raises(RuntimeError):
        client.sync_read_raw_present_position([1, 9, 2])


def talk(bus: FeetechBus, data: bytes, *, size: int = 6, baud: int = 1_000_000) -> bytes:
    """What comes back, up to so many bytes."""
    with serial.Serial(str(bus.port), baud, timeout=5) as port:
        port.write(data)
        return port.read(size)


def nothing(bus: FeetechBus, data: bytes, *, baud: int = 1_000_000) -> bool:
    """Whether nothing comes back before the answer to a ping that is sent behind it."""
    return talk(bus, data + encode(3, 1), baud=baud) == status(3, 0)


def test_a_reg_write_waits_for_its_action(bus: FeetechBus) -> None:
    assert talk(bus, encode(1, 4, bytes((41, 7)))) == status(1, 0)
    assert talk(bus, encode(1, 2, bytes((41, 1))), size=7) == status(1, 0, b"\0")
    assert nothing(bus, encode(254, 5))
    assert talk(bus, encode(1, 2, bytes((41, 1))), size=7) == status(1, 0, b"\7")


@pytest.mark.parametrize(
    "data",
    [
        encode(1, 1)[:-1] + b"\0",
        encode(1, 0x55),
        encode(1, 2, b"\x38"),
        encode(9, 1),
        encode(254, 3, bytes((41, 1))),
        b"\xff\xff\x01",
    ],
    ids=["checksum", "unknown", "too short", "another id", "broadcast write", "cut off"],
)
def test_meaningless_and_unaddressed_messages_are_not_answered(bus: FeetechBus, data: bytes) -> None:
    assert nothing(bus, data)


def test_at_status_level_0_only_pings_and_reads_are_answered(bus: FeetechBus) -> None:
    talk(bus, encode(1, 3, bytes((8, 0))))
    assert nothing(bus, encode(1, 3, bytes((41, 5))))
    assert talk(bus, encode(1, 2, bytes((41, 1))), size=7) == status(1, 0, b"\5")


def test_another_baud_rate_is_noise(make_bus: Callable[..., FeetechBus]) -> None:
    bus = make_bus(3, baud=115_200)
    assert talk(bus, encode(3, 1), baud=115_200) == status(3, 0)
    with serial.Serial(str(bus.port), 1_000_000, timeout=0.05) as port:
        port.write(encode(3, 1))
        assert port.read(6) == b""
    assert events(bus.log.entries, "wrong_baud")


def test_two_of_one_id_answer_on_top_of_each_other(make_bus: Callable[..., FeetechBus]) -> None:
    bus = make_bus(1, 1)
    one = status(1, 0)
    assert talk(bus, encode(1, 1), size=12) == bytes(byte for byte in one for _ in range(2))


@pytest.mark.parametrize(
    ("fault", "answer"),
    [
        (sim.BadCrc(), status(1, 0)[:-1] + bytes((status(1, 0)[-1] ^ 0xFF,))),
        (sim.Garbage(hex="ffff"), b"\xff\xff" + status(1, 0)),
        (sim.Truncate(missing=2), status(1, 0)[:-2]),
        (sim.Duplicate(), 2 * status(1, 0)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_answers_can_be_spoilt(bus: FeetechBus, fault: sim.Command, answer: bytes) -> None:
    bus.do(fault)
    assert talk(bus, encode(1, 1), size=len(answer)) == answer


@pytest.mark.parametrize("order", [sim.Freeze(tick=True), sim.Put()], ids=["a clock", "a hand"])
def test_what_a_servo_has_not_got_is_refused(bus: FeetechBus, order: sim.Command) -> None:
    with pytest.raises(sim.SimulationError, match="nothing that happens to an STS3215"):
        bus.do(order)


def test_packets_may_break_anywhere() -> None:
    data = b"\xff" + encode(1, 1) + b"\xff\xff\xff" + encode(2, 3, b"\x2a\xff\xff") + encode(3, 1)
    reader = PacketReader()
    found = [packet.device_id for byte in data for packet in reader.feed(bytes((byte,)))]
    assert found == [1, 2, 3]


def test_the_program_brings_it_up_from_a_robot_file(tmp_path: Path) -> None:
    file = tmp_path / "tail.toml"
    file.write_text(TAIL)
    with SimProcess(file, paced=False) as process:
        with closing(rustypot.Sts3215PyController(process.ports["tail"], 1_000_000, 2.0)) as client:
            assert client.sync_read_raw_present_position([1, 2]) == [2048, 2048]
            process.control.do(sim.Place(ids=(2,), counts=1048))
            assert client.read_raw_present_position(2) == [1048]
        assert process.control.device("tail.tip").position_rad == pytest.approx(1.534, abs=0.001)


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("STS3215", "STS9999", "is not simulated; there is STS3095, STS3215, STS3250"),
        ("port =", "baud = 9600\nport =", "is no rate of"),
    ],
)
def test_what_is_not_simulated_is_named(tmp_path: Path, before: str, after: str, complaint: str) -> None:
    file = tmp_path / "tail.toml"
    file.write_text(TAIL.replace(before, after))
    ended = subprocess.run(
        [sys.executable, "-m", "trade_hil_sim", str(file)], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == 2
    assert complaint in ended.stderr
