"""The vendor's own library, unmodified, drives the simulated bus."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import dynamixel_sdk
import pytest

from tests.support.waiting import wait_until
from trade_hil_sim import DynamixelBus, Servo, instructions, motion_writes, writes

pytestmark = pytest.mark.realtime

OK = (0, 0)
TORQUE, GOAL, POSITION = 64, 116, 132


@pytest.fixture
def group(sdk: SimpleNamespace) -> Callable[..., Any]:
    """Makes the library's group objects for ids 1, 2 and 3."""

    def make(kind: Any, *args: int) -> Any:
        return kind(sdk.port, sdk.ph, *args)

    return make


def test_ping_answers_model_and_an_absent_id_is_silence(sdk: SimpleNamespace) -> None:
    assert sdk.ph.ping(sdk.port, 1) == (1060, *OK)
    assert sdk.ph.ping(sdk.port, 9)[1] == dynamixel_sdk.COMM_RX_TIMEOUT


def test_a_broadcast_ping_finds_all_servos(sdk: SimpleNamespace) -> None:
    assert sdk.ph.broadcastPing(sdk.port) == ({1: [1060, 45], 2: [1060, 45], 3: [1060, 45]}, 0)


def test_read_and_write(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    assert sdk.ph.read4ByteTxRx(sdk.port, 1, POSITION) == (2048, *OK)
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 65, 1) == OK
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 65) == (1, *OK)
    assert sdk.ph.readTxRx(sdk.port, 2, 126, 10) == (list(bytes(6) + b"\0\x08\0\0"), *OK)
    assert [e.registers for e in writes(bus.log.entries)] == [("led",)]
    assert motion_writes(bus.log.entries) == []


def test_a_move_is_seen_by_client_and_log(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, TORQUE, 1) == OK
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, GOAL, 2200) == OK
    wait_until(lambda: sdk.ph.read1ByteTxRx(sdk.port, 1, 122)[0] == 0, "the end of the motion")
    assert sdk.ph.read4ByteTxRx(sdk.port, 1, POSITION) == (2200, *OK)
    story = [e.name for e in bus.log.entries if e.kind == "event"]
    assert story == ["torque_on", "motion_started", "at_rest"]
    assert [e.registers for e in motion_writes(bus.log.entries, device_id=1)] == [
        ("torque_enable",),
        ("goal_position",),
    ]
    assert motion_writes(bus.log.entries, device_id=2) == []
    end = next(e for e in bus.log.entries if e.name == "at_rest")
    assert (end.device_id, end.position_counts) == (1, 2200)


def test_the_log_has_the_position_of_a_servo_when_it_gets_a_goal(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, TORQUE, 1) == OK
    for goal in (2200, 2100):
        assert sdk.ph.write4ByteTxRx(sdk.port, 1, GOAL, goal) == OK
        wait_until(lambda: sdk.ph.read1ByteTxRx(sdk.port, 1, 122)[0] == 0, "the end of the motion")
    reported = motion_writes(bus.log.entries, device_id=1)
    assert [entry.position_counts for entry in reported] == [2048, 2048, 2200]
    assert len({entry.joint for entry in reported}) == 1


def test_reg_write_and_action(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    assert sdk.ph.regWriteTxRx(sdk.port, 2, GOAL, 4, [0, 9, 0, 0]) == OK
    assert sdk.ph.read4ByteTxRx(sdk.port, 2, GOAL) == (2048, *OK)
    assert sdk.ph.read1ByteTxRx(sdk.port, 2, 69) == (1, *OK)
    assert sdk.ph.action(sdk.port, 254) == 0
    assert sdk.ph.read4ByteTxRx(sdk.port, 2, GOAL) == (0x900, *OK)
    assert [(e.name, e.moves) for e in writes(bus.log.entries)] == [("reg_write", True), ("action", True)]


def test_errors_arrive_with_the_manuals_numbers(sdk: SimpleNamespace) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, TORQUE, 1) == OK
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 11, 4) == (0, 7)
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, GOAL, 5000) == (0, 6)
    assert sdk.ph.write2ByteTxRx(sdk.port, 1, GOAL, 1) == (0, 5)
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 65, 2) == (0, 4)
    assert sdk.ph.writeTxRx(sdk.port, 1, 700, 1, [1]) == (0, 7)


def test_an_instruction_it_does_not_know_is_error_2(sdk: SimpleNamespace) -> None:
    packet = [0, 0, 0, 0, 1, 3, 0, 0x77, 0, 0]
    _, result, error = sdk.ph.txRxPacket(sdk.port, packet)
    assert (result, error) == (0, 2)


def test_sync_read_and_sync_write(sdk: SimpleNamespace, group: Any, bus: DynamixelBus) -> None:
    goals = group(dynamixel_sdk.GroupSyncWrite, GOAL, 4)
    for k in (1, 2, 3):
        assert goals.addParam(k, (2000 + k).to_bytes(4, "little"))
    assert goals.txPacket() == 0
    read = group(dynamixel_sdk.GroupSyncRead, GOAL, 4)
    for k in (3, 1, 2):
        assert read.addParam(k)
    assert read.txRxPacket() == 0
    assert [read.getData(k, GOAL, 4) for k in (1, 2, 3)] == [2001, 2002, 2003]
    assert [e.device_id for e in motion_writes(bus.log.entries)] == [1, 2, 3]
    assert instructions(bus.log.entries, "sync_read", device_id=2)[0].ids == (3, 1, 2)


def test_fast_sync_read_is_one_joined_answer(sdk: SimpleNamespace, group: Any, bus: DynamixelBus) -> None:
    read = group(dynamixel_sdk.GroupSyncRead, 126, 10)
    for k in (1, 2, 3):
        assert read.addParam(k)
    assert read.fastSyncRead() == 0
    assert [read.getData(k, POSITION, 4) for k in (1, 2, 3)] == [2048] * 3
    assert len([e for e in bus.log.entries if e.kind == "sent"]) == 1


@pytest.mark.parametrize("fast", [False, True])
def test_bulk_read_takes_different_registers_of_each(sdk: SimpleNamespace, group: Any, fast: bool) -> None:
    read = group(dynamixel_sdk.GroupBulkRead)
    assert read.addParam(1, POSITION, 4)
    assert read.addParam(2, 144, 2)
    assert read.addParam(3, 146, 1)
    assert (read.fastBulkRead() if fast else read.txRxPacket()) == 0
    assert (read.getData(1, POSITION, 4), read.getData(2, 144, 2), read.getData(3, 146, 1)) == (2048, 120, 30)


def test_bulk_write_writes_different_registers_of_each(sdk: SimpleNamespace, group: Any, bus: DynamixelBus) -> None:
    write = group(dynamixel_sdk.GroupBulkWrite)
    assert write.addParam(1, GOAL, 4, [0, 9, 0, 0])
    assert write.addParam(2, 65, 1, [1])
    assert write.txPacket() == 0
    assert sdk.ph.read4ByteTxRx(sdk.port, 1, GOAL) == (0x900, *OK)
    assert sdk.ph.read1ByteTxRx(sdk.port, 2, 65) == (1, *OK)
    assert [(e.device_id, e.moves) for e in writes(bus.log.entries)] == [(1, True), (2, False)]


def test_reboot_answers_first_then_forgets_ram(sdk: SimpleNamespace) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 65, 1) == OK
    assert sdk.ph.reboot(sdk.port, 1) == OK
    assert sdk.ph.ping(sdk.port, 2) == (1060, *OK)
    wait_until(lambda: sdk.ph.ping(sdk.port, 1) == (1060, *OK), "the servo after its reboot")
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 65) == (0, *OK)


def test_factory_reset_spares_id_and_baud_on_request(sdk: SimpleNamespace) -> None:
    assert sdk.ph.write4ByteTxRx(sdk.port, 2, 24, 99) == OK
    assert sdk.ph.factoryReset(sdk.port, 2, 0x02) == OK
    wait_until(lambda: sdk.ph.read4ByteTxRx(sdk.port, 2, 24) == (10, *OK), "the servo after its reset")


def test_a_factory_reset_of_everything_is_not_open_to_broadcast(sdk: SimpleNamespace) -> None:
    assert sdk.ph.write4ByteTxRx(sdk.port, 2, 24, 99) == OK
    sdk.ph.factoryReset(sdk.port, 254, 0xFF)
    assert sdk.ph.read4ByteTxRx(sdk.port, 2, 24) == (99, *OK)


def test_clear_forgets_whole_turns(sdk: SimpleNamespace) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 11, 4) == OK
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, TORQUE, 1) == OK
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, GOAL, 4200) == OK
    assert sdk.ph.clearMultiTurn(sdk.port, 1) == (0, 1)
    wait_until(lambda: sdk.ph.read1ByteTxRx(sdk.port, 1, 122)[0] == 0, "the end of the motion")
    assert sdk.ph.clearMultiTurn(sdk.port, 1) == OK
    assert sdk.ph.read4ByteTxRx(sdk.port, 1, POSITION) == (104, *OK)


def test_indirect_addresses_gather_scattered_registers(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    for k, address in enumerate((132, 133, 134, 135, 70, 146, 116, 117, 118, 119)):
        assert sdk.ph.write2ByteTxRx(sdk.port, 1, 168 + 2 * k, address) == OK
    assert sdk.ph.readTxRx(sdk.port, 1, 224, 6) == ([0, 8, 0, 0, 0, 30], *OK)
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, 230, 2222) == OK
    assert sdk.ph.read4ByteTxRx(sdk.port, 1, GOAL) == (2222, *OK)
    # the judge looks through the indirection
    assert [e.registers for e in motion_writes(bus.log.entries)] == [("goal_position",)]


def test_s06_a_silent_client_stops_the_servo(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, TORQUE, 1) == OK
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, 112, 10) == OK
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 98, 25) == OK
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, GOAL, 4000) == OK
    wait_until(lambda: any(e.name == "at_rest" for e in bus.log.entries), "the stop")
    expired, rest = (next(e for e in bus.log.entries if e.name == n) for n in ("watchdog_expired", "at_rest"))
    assert expired.t - instructions(bus.log.entries)[-1].t >= 0.5
    assert rest.t - expired.t < 0.1
    assert rest.position_counts is not None
    assert rest.position_counts < 4000
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 98) == (255, *OK)
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, GOAL, 2048) == (0, 4)
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 98, 0) == OK
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, GOAL, 2048) == OK


def test_the_status_return_level_decides_what_is_answered(sdk: SimpleNamespace) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 68, 1) == OK
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 68) == (1, *OK)
    assert sdk.ph.write1ByteTxRx(sdk.port, 1, 65, 1)[0] == dynamixel_sdk.COMM_RX_TIMEOUT
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 65) == (1, *OK)
    sdk.ph.write1ByteTxOnly(sdk.port, 1, 68, 0)
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 65)[1] == dynamixel_sdk.COMM_RX_TIMEOUT
    assert sdk.ph.ping(sdk.port, 1) == (1060, *OK)


def test_a_secondary_id_obeys_writes_to_ram_without_answering(sdk: SimpleNamespace) -> None:
    for k in (1, 2):
        assert sdk.ph.write1ByteTxRx(sdk.port, k, 12, 100) == OK
    assert sdk.ph.write1ByteTxRx(sdk.port, 100, 65, 1)[0] == dynamixel_sdk.COMM_RX_TIMEOUT
    assert [sdk.ph.read1ByteTxRx(sdk.port, k, 65)[0] for k in (1, 2, 3)] == [1, 1, 0]
    sdk.ph.write1ByteTxOnly(sdk.port, 100, 9, 0)
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 9) == (250, *OK)


def test_a_new_id_is_known_at_once_by_its_new_name(sdk: SimpleNamespace) -> None:
    assert sdk.ph.write1ByteTxRx(sdk.port, 3, 7, 30)[0] == 0
    assert sdk.ph.ping(sdk.port, 30) == (1060, *OK)


def test_at_another_baud_rate_no_servo_answers(bus: DynamixelBus, open_sdk: Any) -> None:
    slow = open_sdk(bus, baud=57_600)
    assert slow.ph.ping(slow.port, 1)[1] == dynamixel_sdk.COMM_RX_TIMEOUT
    assert [e.name for e in bus.log.entries if e.kind == "event"] == ["wrong_baud"]
    assert slow.port.setBaudRate(1_000_000)
    assert slow.ph.write1ByteTxRx(slow.port, 1, 8, 1) == OK
    assert slow.port.setBaudRate(57_600)
    assert slow.ph.ping(slow.port, 1) == (1060, *OK)
    assert slow.ph.ping(slow.port, 2)[1] == dynamixel_sdk.COMM_RX_TIMEOUT


def test_two_servos_of_one_id_answer_on_top_of_each_other(make_bus: Any, open_sdk: Any) -> None:
    bus = make_bus(Servo(1), Servo(1, position_counts=1000), 2)
    sdk = open_sdk(bus)
    assert sdk.ph.read4ByteTxRx(sdk.port, 1, POSITION)[1] != 0
    wait_until(lambda: any(e.kind == "sent" for e in bus.log.entries), "they have answered")  # later than it waits
    assert len(next(e for e in bus.log.entries if e.kind == "sent").data) == 30
    assert sdk.ph.ping(sdk.port, 2) == (1060, *OK)


def test_a_latched_error_alerts_in_every_answer(sdk: SimpleNamespace, bus: DynamixelBus) -> None:
    from trade_hil_sim import HardwareFault

    bus.do(HardwareFault(ids=(1,), bits=0x20))
    assert sdk.ph.read1ByteTxRx(sdk.port, 1, 70) == (0x20, 0, 0x80)
    assert sdk.ph.write4ByteTxRx(sdk.port, 1, GOAL, 9999) == (0, 0x86)
    assert sdk.ph.read1ByteTxRx(sdk.port, 2, 70) == (0, *OK)


def test_paced_answers_take_as_long_as_the_wire(make_bus: Any, open_sdk: Any) -> None:
    """A lower bound only: what a busy machine adds is its own affair."""
    bus = make_bus(1, 2, paced=True)
    sdk = open_sdk(bus)
    assert sdk.ph.readTxRx(sdk.port, 1, 64, 80)[1] == 0
    ask, answer = (next(e for e in bus.log.entries if e.kind == kind) for kind in ("received", "sent"))
    wire_s = (len(ask.data) + len(answer.data)) * 10 / 1_000_000
    assert answer.t - ask.t >= wire_s + 250 * 2e-6
