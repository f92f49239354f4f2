"""Every scripted fault, as the vendor's library sees it."""

from types import SimpleNamespace
from typing import Any

import dynamixel_sdk
import pytest

from tests.support.waiting import wait_until
from trade_hil_sim import (
    Absent,
    BadCrc,
    BrownOut,
    Command,
    Dribble,
    Duplicate,
    DynamixelBus,
    Echo,
    Freeze,
    Garbage,
    HangUp,
    Heal,
    Jam,
    Late,
    Local,
    Mute,
    Place,
    Replug,
    SimulationError,
    Supply,
    Truncate,
    Unmute,
    Unplug,
    WrongModel,
    instructions,
)

TIMEOUT, CORRUPT = dynamixel_sdk.COMM_RX_TIMEOUT, dynamixel_sdk.COMM_RX_CORRUPT
POSITION = 132


@pytest.fixture
def read(sdk: SimpleNamespace) -> Any:
    """Position of a servo as the client reads it: value, result, error."""
    return lambda device_id=1: sdk.ph.read4ByteTxRx(sdk.port, device_id, POSITION)


GOOD = (2048, 0, 0)


def test_a_muted_device_obeys_but_does_not_answer(sdk: SimpleNamespace, bus: DynamixelBus, read: Any) -> None:
    bus.do(Mute(ids=(1,)))
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 65, 1)[0] == TIMEOUT
    assert read(2) == GOOD
    bus.do(Unmute(ids=(1,)))
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 65) == (1, 0, 0)


@pytest.mark.slow
def test_a_whole_bus_can_be_muted(bus: DynamixelBus, read: Any) -> None:
    bus.do(Mute())
    assert [read(k)[1] for k in (1, 2, 3)] == [TIMEOUT] * 3
    bus.do(Heal())
    assert read() == GOOD


@pytest.mark.slow
def test_a_fault_can_be_counted_skipped_and_bound_to_an_instruction(
    sdk: SimpleNamespace, bus: DynamixelBus, read: Any
) -> None:
    bus.do(Mute(ids=(1,), instruction="read", skip=1, count=2))
    results = []
    for _ in range(4):
        assert sdk.ph.ping(sdk.port, 1)[1] == 0
        results.append(read()[1])
    assert results == [0, TIMEOUT, TIMEOUT, 0]


@pytest.mark.parametrize("fast", [False, True])
def test_one_silent_device_spoils_a_group_read(sdk: SimpleNamespace, bus: DynamixelBus, fast: bool) -> None:
    bus.do(Mute(ids=(2,)))
    group = dynamixel_sdk.GroupSyncRead(sdk.port, sdk.ph, POSITION, 4)
    for k in (1, 2, 3):
        group.addParam(k)
    assert (group.fastSyncRead() if fast else group.txRxPacket()) != 0


def test_a_late_answer_is_taken_for_the_next_one(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    """What every driver must guard against: nothing in the protocol ties an answer to its question."""
    for _ in range(5):  # should this process sleep just when the answer comes, the client's flush takes it
        bus.do(Heal())
        bus.do(Late(s=0.3, count=1))
        bus.do(Mute(skip=1))
        assert sdk.ph.read4ByteTxRx(sdk.port, 1, POSITION)[1] == TIMEOUT
        profile_velocity, result, _ = sdk.ph.read4ByteTxRx(sdk.port, 1, 112)
        if result == 0:
            break
    assert (result, profile_velocity) == (0, 2048)


def test_a_late_answer_leaves_while_the_bus_continues(make_bus: Any) -> None:
    import serial

    from trade_hil_sim.dynamixel import encode

    bus = make_bus(1, 2)
    bus.do(Late(ids=(1,), s=0.2))
    with serial.Serial(str(bus.port), 1_000_000, timeout=5) as port:
        port.write(encode(1, 1) + encode(2, 1))
        first, second = port.read(14), port.read(14)
    assert (first[4], second[4]) == (2, 1)


def test_a_bad_crc_is_corrupt(bus: DynamixelBus, read: Any) -> None:
    bus.do(BadCrc(ids=(1,), count=1))
    assert read()[1] == CORRUPT
    assert read() == GOOD


def test_a_truncated_answer_is_corrupt(bus: DynamixelBus, read: Any) -> None:
    bus.do(Truncate(count=1, missing=5))
    assert read()[1] == CORRUPT
    assert read() == GOOD


@pytest.mark.parametrize("noise", ["00", "fffffd", "fffffd00ff", "deadbeef"])
def test_noise_before_an_answer_is_skipped(bus: DynamixelBus, read: Any, noise: str) -> None:
    bus.do(Garbage(hex=noise))
    assert read() == GOOD


def test_a_dribbled_answer_is_put_together(bus: DynamixelBus, read: Any) -> None:
    bus.do(Dribble(s=0.001))
    assert read() == GOOD
    assert [len(e.data) for e in bus.log.entries if e.kind == "sent"] == [1] * 15


def test_an_answer_twice_is_read_once(bus: DynamixelBus, read: Any) -> None:
    bus.do(Duplicate(count=1))
    assert read() == GOOD
    assert read() == GOOD
    wait_until(lambda: len([e for e in bus.log.entries if e.kind == "sent"]) == 3, "the third answer")


def test_an_echoing_adapter_sends_the_question_back(bus: DynamixelBus, read: Any) -> None:
    bus.do(Echo())
    assert read() == GOOD
    question, answer = (e.data for e in bus.log.entries if e.kind == "sent")
    assert question[7] == 2
    assert answer[7] == 0x55
    bus.do(Echo(on=False))
    assert read() == GOOD


def test_faults_act_together(bus: DynamixelBus, read: Any) -> None:
    bus.do(Garbage(hex="00"))
    bus.do(Dribble(s=0.0005))
    bus.do(Duplicate())
    assert read() == GOOD


def test_an_absent_device_neither_hears_nor_answers(sdk: SimpleNamespace, bus: DynamixelBus, read: Any) -> None:
    bus.do(Absent(ids=(1,)))
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 65, 1)[0] == TIMEOUT
    bus.do(Absent(ids=(1,), on=False))
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 65) == (0, 0, 0)


def test_a_swapped_device_reports_another_model(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    bus.do(WrongModel(ids=(2,), number=1020))
    assert sdk.ph.ping(sdk.port, 2) == (1020, 0, 0)
    bus.do(Heal())
    assert sdk.ph.ping(sdk.port, 2) == (1060, 0, 0)


@pytest.mark.slow
def test_a_brown_out_switches_torque_off_and_keeps_eeprom(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 9, 0) == (0, 0)
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 64, 1) == (0, 0)
    bus.do(BrownOut())
    wait_until(lambda: sdk.ph.ping(sdk.port, 1) == (1060, 0, 0), "the servo after the dip")
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 64) == (0, 0, 0)
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 9) == (0, 0, 0)


def test_an_overheated_device_shuts_down(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 64, 1) == (0, 0)
    bus.do(Supply(ids=(1,), temperature_c=80))
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 64) == (0, 0, 0x80)
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 70) == (4, 0, 0x80)


def test_a_frozen_sensor_looks_healthy(sdk: SimpleNamespace, bus: DynamixelBus, read: Any) -> None:
    bus.do(Freeze(ids=(1,)))
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 64, 1) == (0, 0)
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, 116, 2200) == (0, 0)
    wait_until(lambda: bus.state().devices[0].position_counts == 2200)
    assert read() == GOOD


def test_a_jammed_shaft_stays(sdk: SimpleNamespace, bus: DynamixelBus, read: Any) -> None:
    bus.do(Jam(ids=(1,)))
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 64, 1) == (0, 0)
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, 116, 2200) == (0, 0)
    assert read() == GOOD
    assert sdk.ph.read2ByteTxRx(sdk.port, 1, 126) == (1000, 0, 0)


def test_a_shaft_can_be_turned_by_hand(bus: DynamixelBus, read: Any) -> None:
    bus.do(Place(ids=(3,), counts=123))
    assert read(3) == (123, 0, 0)


def test_a_damaged_question_is_error_3_and_feeds_no_watchdog(make_bus: Any) -> None:
    import serial

    from trade_hil_sim.dynamixel import PacketReader, encode

    bus = make_bus(1)
    damaged = bytearray(encode(1, 3, bytes([65, 0, 1])))
    damaged[-1] ^= 0xFF
    with serial.Serial(str(bus.port), 1_000_000, timeout=5) as port:
        port.write(damaged)
        [answer] = PacketReader().feed(port.read(11))
    assert answer.params == b"\x03"
    assert [e.name for e in instructions(bus.log.entries)] == ["damaged write"]
    assert bus.state().devices[0].torque is False


def test_a_fault_for_a_device_that_is_not_there_is_an_error(bus: DynamixelBus) -> None:
    with pytest.raises(SimulationError, match=r"no device \[9\]; it has \[1, 2, 3\]"):
        bus.do(Mute(ids=(9,)))


def test_s06_an_unplugged_servo_continues_until_its_watchdog_stops_it(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    """The adapter is gone, the supply is not."""
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 64, 1) == (0, 0)
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, 112, 10) == (0, 0)
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 98, 10) == (0, 0)
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, 116, 4000) == (0, 0)
    bus.do(Unplug())
    wait_until(lambda: not bus.state().devices[0].moving, "the stop")
    state = bus.state().devices[0]
    assert (state.watchdog, state.torque) == (255, True)
    assert 2048 < state.position_counts < 4000
    bus.do(Replug())
    assert bus.state().plugged


@pytest.mark.parametrize("command", [Local(), HangUp(kind="rtde")], ids=["local", "hang up"])
def test_what_only_controllers_of_arms_know_is_refused(bus: DynamixelBus, command: Command) -> None:
    with pytest.raises(SimulationError, match="no controller"):
        bus.do(command)
