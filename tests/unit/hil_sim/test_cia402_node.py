"""The CANopen side of the simulated drive, in frames checked by hand: CiA 301."""

from collections.abc import Callable

import pytest

from tests.unit.hil_sim.drive_bench import MODEL, NODE, Bench
from trade_hil_sim import Frame
from trade_hil_sim.cia402 import Cia402Bus

pytestmark = pytest.mark.virtual_time

START, STOP, PRE_OP, RESET, RESET_COMM = "01", "02", "80", "81", "82"


@pytest.fixture
def running(bench: Bench) -> Bench:
    """In OPERATIONAL; what it said so far is forgotten."""
    bench.hear(0, "0105")
    bench.sent.clear()
    return bench


# network management


def test_it_boots_once_and_is_then_pre_operational(bench: Bench) -> None:
    assert bench.frames() == ["00"]
    assert bench.sent[0][1].can_id == 0x705
    bench.put(0x1017, 100, 2)
    bench.run(0.35)
    assert bench.frames(0x705) == ["00", "7f", "7f", "7f"]


@pytest.mark.parametrize(("command", "state"), [("01", "05"), ("02", "04"), ("80", "7f")])
def test_heartbeats_show_the_state_that_was_commanded(bench: Bench, command: str, state: str) -> None:
    bench.put(0x1017, 100, 2)
    for whom in ("06", "05", "00"):
        bench.hear(0, "0105")
        bench.hear(0, command + whom)
        bench.sent.clear()
        bench.run(0.11)
        assert bench.frames(0x705) == ["05" if whom == "06" else state]


@pytest.mark.parametrize(("command", "keeps"), [(RESET, False), (RESET_COMM, True)])
def test_a_reset_boots_again_and_forgets_communication_or_everything(running: Bench, command: str, keeps: bool) -> None:
    running.put(0x1017, 100, 2)
    running.put(0x6081, 777, 4)
    running.hear(0, command + "05")
    running.sent.clear()
    running.hear(0x605, "4000100000000000")
    assert running.frames() == []  # it boots, and is deaf
    running.run(0.3)
    assert running.frames() == ["00"]
    assert running.get(0x1017) == 0
    assert running.get(0x6081) == (777 if keeps else 20_000)


def test_heartbeats_come_at_their_period_in_every_state(bench: Bench) -> None:
    bench.put(0x1017, 50, 2)
    begun = bench.t
    for command in ("0105", "0205", "8005"):
        bench.hear(0, command)
        bench.run(0.1)
    assert bench.times(0x705)[1:] == pytest.approx([begun + 0.05 * k for k in range(1, 7)])


def test_a_stopped_node_knows_only_network_management(running: Bench) -> None:
    running.hear(0, "0205")
    running.hear(0x605, "4000100000000000")
    running.hear(0x205, "0600")
    running.hear(0x80)
    assert running.frames() == []
    running.hear(0, "0105")
    assert running.get(0x1000) == 0x0002_0192


# SDO

UPLOADS = {
    "4000100000000000": "4300100092010200",  # 4 bytes
    "4041600000000000": "4b41600070020000",  # 2 bytes: 0270h, voltage, quick stop, remote, disabled
    "4061600000000000": "4f61600000000000",  # 1 byte
}
ABORTS = {
    "no such object": ("4000200000000000", "8000200000000206"),
    "no such subindex": ("4018100900000000", "8018100911000906"),
    "write of read-only": ("2b41600000000000", "8041600002000106"),
    "too long": ("2340600006000000", "8040600012000706"),
    "too short": ("2f40600006000000", "8040600013000706"),
    "value out of range": ("2f60600005000000", "8060600030000906"),
    "unknown command": ("e000100000000000", "8000100001000405"),
    "segment without a transfer": ("6000000000000000", "8000000001000405"),
    "cannot store": ("2310100173617665", "8010100120000008"),
    "block upload": ("a008100000000000", "8008100001000405"),
}


@pytest.mark.parametrize(("request_", "answer"), UPLOADS.items())
def test_up_to_four_bytes_are_read_in_one_answer(bench: Bench, request_: str, answer: str) -> None:
    assert bench.sdo(request_) == answer


@pytest.mark.parametrize("what", ABORTS)
def test_the_impossible_is_refused_with_its_code(bench: Bench, what: str) -> None:
    request, answer = ABORTS[what]
    assert bench.sdo(request) == answer


def test_up_to_four_bytes_are_written_in_one_request(bench: Bench) -> None:
    assert bench.sdo("23816000e8030000") == "6081600000000000"
    assert bench.sdo("4081600000000000") == "43816000e8030000"
    assert bench.sdo("22816000d2040000") == "6081600000000000"  # without a length, four
    assert bench.get(0x6081) == 1234


def test_a_name_is_read_in_segments(bench: Bench) -> None:
    assert bench.sdo("4009100000000000") == "4709100073696d00"  # "sim" fits
    assert bench.sdo("4008100000000000") == "410810001d000000"
    text, toggle = b"", 0
    while True:
        answer = bytes.fromhex(bench.sdo(f"{0x60 | toggle:02x}00000000000000"))
        assert answer[0] & 0x10 == toggle
        text += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
        if answer[0] & 1:
            break
    assert text == MODEL.encode()
    assert bench.sdo("6000000000000000")[:2] == "80"


def test_a_wrong_toggle_ends_a_transfer(bench: Bench) -> None:
    bench.sdo("4008100000000000")
    assert bench.sdo("7000000000000000") == "8008100000000305"
    assert bench.sdo("6000000000000000") == "8008100001000405"


def test_numbers_can_be_written_in_segments_of_the_length_announced(bench: Bench) -> None:
    assert bench.sdo("2181600004000000") == "6081600000000000"
    assert bench.sdo("0739050000000000") == "2000000000000000"
    assert bench.get(0x6081) == 1337
    bench.sdo("2181600003000000")
    assert bench.sdo("0739050000000000") == "8081600010000706"


def test_a_client_may_abort_a_transfer(bench: Bench) -> None:
    bench.sdo("4008100000000000")
    bench.hear(0x605, "8008100000000405")
    assert bench.sdo("6000000000000000")[:2] == "80"


# PDO


def test_receive_pdos_take_effect_at_once_or_at_sync(running: Bench) -> None:
    running.hear(0x205, "0600")
    assert running.status & 0x6F == 0x21
    running.hear(0x205, "0000")
    running.put(0x1400, 1, 1, 2)
    running.hear(0x205, "0600")
    assert running.status & 0x4F == 0x40
    running.hear(0x80)
    assert running.status & 0x6F == 0x21


def test_receive_pdos_are_ignored_unless_operational(bench: Bench) -> None:
    bench.hear(0x205, "0600")
    assert bench.status & 0x4F == 0x40


def test_transmit_pdos_come_at_every_nth_sync(running: Bench) -> None:
    running.put(0x1800, 3, 1, 2)
    running.sent.clear()
    for _ in range(7):
        running.hear(0x80)
    assert running.frames(0x185) == ["7002", "7002"]


def test_an_acyclic_synchronous_pdo_comes_at_sync_after_a_change(running: Bench) -> None:
    running.put(0x1800, 0, 1, 2)
    running.sent.clear()
    for _ in range(3):
        running.hear(0x80)
    running.control(0x06)
    assert running.frames(0x185) == ["7002"]
    running.hear(0x80)
    running.hear(0x80)
    assert running.frames(0x185) == ["7002", "3102"]


def test_an_event_driven_pdo_is_sent_only_on_change(running: Bench) -> None:
    running.run(1.0)
    assert running.frames() == []
    running.control(0x06)
    running.control(0x06)
    assert running.frames(0x185) == ["3102"]


def test_an_inhibit_time_holds_a_pdo_back_and_its_last_value_counts(running: Bench) -> None:
    assert running.try_put(0x1800, 500, 2, 3) == 0x0800_0022  # not while it is valid
    running.put(0x1800, 0xC000_0185, 4, 1)
    running.put(0x1800, 500, 2, 3)
    running.put(0x1800, 0x4000_0185, 4, 1)
    running.sent.clear()
    for word in (0x06, 0x07, 0x06, 0x07):
        running.control(word)
    assert running.frames(0x185) == []
    begun = running.t
    running.run(0.2)
    assert running.frames(0x185) == ["3302"]
    assert running.times(0x185) == pytest.approx([begun + 0.05])


def test_an_event_timer_sends_what_does_not_change(running: Bench) -> None:
    running.put(0x1800, 20, 2, 5)
    running.sent.clear()
    running.run(0.11)
    assert len(running.frames(0x185)) == 5


def remap(bench: Bench, index: int, cob_id: int, entries: list[int]) -> None:
    """The order the standard asks for."""
    bench.put(index, 1 << 31 | cob_id, 4, 1)
    bench.put(index + 0x200, 0, 1)
    for k, entry in enumerate(entries, 1):
        bench.put(index + 0x200, entry, 4, k)
    bench.put(index + 0x200, len(entries), 1)
    bench.put(index, cob_id, 4, 1)


def test_pdos_can_be_remapped(running: Bench) -> None:
    remap(running, 0x1801, 0x285, [0x6064_0020, 0x6061_0008, 0x6041_0010])
    assert running.frames(0x285) == ["00000000" + "00" + "7002"]
    remap(running, 0x1401, 0x305, [0x0005_0008, 0x6040_0010, 0x607A_0020])  # a dummy skips a byte
    running.hear(0x305, "ff" + "0600" + "39300000")
    assert (running.get(0x607A), running.status & 0x6F) == (12345, 0x21)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda b: b.try_put(0x1A00, 0, 1), 0x0800_0022),  # while it is valid
        (lambda b: b.try_put(0x1A01, 0x6041_0010, 4, 1), 0x0800_0022),  # while its count is not 0
        (lambda b: b.try_put(0x1800, 0x186, 4, 1), 0x0800_0022),  # another id while it is valid
        (lambda b: b.try_put(0x1800, 252, 1, 2), 0x0609_0030),
        (lambda b: b.put(0x1A01, 0, 1) or b.try_put(0x1A01, 0x1008_0020, 4, 1), 0x0604_0041),
        (lambda b: b.put(0x1A01, 0, 1) or b.try_put(0x1A01, 0x6041_0020, 4, 1), 0x0604_0041),
        (lambda b: b.put(0x1A01, 0, 1) or b.try_put(0x1A01, 0x7777_0020, 4, 1), 0x0602_0000),
        (lambda b: b.put(0x1601, 0, 1) or b.try_put(0x1601, 0x6064_0020, 4, 1), 0x0604_0041),
        (lambda b: b.try_put(0x1A01, 9, 1), 0x0609_0030),
    ],
)
def test_a_wrong_mapping_is_refused(bench: Bench, change: Callable[[Bench], int], code: int) -> None:
    assert change(bench) == code


def test_a_map_of_more_than_eight_bytes_is_refused(bench: Bench) -> None:
    bench.put(0x1A01, 0, 1)
    for k in (1, 2, 3):
        bench.put(0x1A01, 0x6064_0020, 4, k)
    assert bench.try_put(0x1A01, 3, 1) == 0x0604_0042
    assert bench.try_put(0x1A01, 2, 1) == 0


@pytest.mark.parametrize(("data", "code", "state"), [("06", "1082", 0x40), ("060000", "2082", 0x21)])
def test_a_pdo_of_the_wrong_length_is_an_emergency(running: Bench, data: str, code: str, state: int) -> None:
    running.hear(0x205, data)
    assert running.frames(0x085) == [code + "11" + "0000000000"]
    assert running.status & 0x4F == state & 0x4F


# heartbeat consumer


def watch(bench: Bench, *, option: int = 1) -> None:
    """It watches node 127, 200 ms."""
    bench.put(0x6007, option, 2)
    bench.put(0x1016, 127 << 16 | 200, 4, 1)


def test_it_does_not_miss_a_heartbeat_before_it_has_heard_one(running: Bench) -> None:
    watch(running)
    running.run(5.0)
    assert running.frames(0x085) == []


def test_a_missed_heartbeat_is_an_emergency_that_ends_when_it_is_back(running: Bench) -> None:
    watch(running)
    for _ in range(10):
        running.hear(0x77F, "05")
        running.run(0.19)
    assert running.frames(0x085) == []
    last = running.t - 0.19
    running.run(1.0)
    assert running.frames(0x085) == ["3081" + "11" + "0000000000"]
    assert running.times(0x085) == pytest.approx([last + 0.2])
    assert (running.get(0x1001), running.get(0x1003, 1), running.get(0x1003)) == (0x11, 0x8130, 1)
    running.hear(0x77E, "05")
    assert running.get(0x1001) == 0x11
    running.hear(0x77F, "05")
    assert running.frames(0x085)[1:] == ["0000" + "00" + "0000000000"]


@pytest.mark.parametrize(("behaviour", "state"), [(0, "7f"), (1, "05"), (2, "04")])
def test_what_becomes_of_the_node_when_a_heartbeat_is_missed(running: Bench, behaviour: int, state: str) -> None:
    watch(running)
    running.put(0x1029, behaviour, 1, 1)
    running.put(0x1017, 100, 2)
    running.hear(0x77F, "05")
    running.run(0.35)
    assert running.frames(0x705)[-1] == state


# errors and names


def test_past_errors_are_kept_newest_first_and_can_be_cleared(running: Bench) -> None:
    for data in ("06", "060000", "06"):
        running.hear(0x205, data)
    assert [running.get(0x1003, k) for k in (0, 1, 2, 3, 4)] == [3, 0x8210, 0x8220, 0x8210, 0]
    assert running.try_put(0x1003, 1, 1) == 0x0609_0030
    running.put(0x1003, 0, 1)
    assert [running.get(0x1003, k) for k in (0, 1)] == [0, 0]


@pytest.mark.parametrize(
    ("can_id", "data", "label"),
    [
        (0x000, "0105", ("nmt", 5)),
        (0x000, "0100", ("nmt", None)),
        (0x080, "", ("sync", None)),
        (0x085, "1082110000000000", ("emcy", 5)),
        (0x185, "4002", ("tpdo1", 5)),
        (0x505, "0600", ("rpdo4", 5)),
        (0x585, "4300100000000000", ("sdo_reply", 5)),
        (0x605, "4000100000000000", ("sdo_request", 5)),
        (0x705, "00", ("boot_up", 5)),
        (0x705, "05", ("heartbeat", 5)),
        (0x7E5, "04", ("", None)),
    ],
)
def test_frames_have_the_names_of_the_predefined_connection_set(can_id: int, data: str, label: object) -> None:
    assert Cia402Bus.label(Frame(can_id, bytes.fromhex(data))) == label


def test_writes_are_in_the_log_and_say_whether_they_could_move_it(running: Bench) -> None:
    running.log.clear()
    running.put(0x6081, 1000, 4)
    running.hear(0x205, "0600")
    running.hear(0x205, "0600")  # repeats what it has: a frame, but no instruction
    running.put(0x6040, 6, 2)
    reported = [(e.name, e.registers, e.moves, e.device_id) for e in running.log if e.kind == "instruction"]
    assert reported == [
        ("sdo_write", ("profile_velocity",), False, NODE),
        ("rpdo1", ("controlword",), True, NODE),
        ("sdo_write", ("controlword",), False, NODE),
    ]
