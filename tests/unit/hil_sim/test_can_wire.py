"""The CAN hub without its clients: text as socketcand speaks it, and a wire that takes its time."""

from math import inf

import pytest

from trade_hil_sim import (
    Frame,
    SimulationError,
)
from trade_hil_sim.can import Reader, Station, Wire, frame_text, parse_send

pytestmark = pytest.mark.virtual_time

# text


def test_text_is_cut_right_whatever_the_segments() -> None:
    text = b"< open can0 >< send 123 3 1 ff a > noise < send 080 0  >"
    whole = [["open", "can0"], ["send", "123", "3", "1", "ff", "a"], ["send", "080", "0"]]
    assert Reader().feed(text) == whole
    reader = Reader()
    assert [words for k in range(len(text)) for words in reader.feed(text[k : k + 1])] == whole


def test_frames_are_written_as_socketcand_writes_them() -> None:
    assert frame_text(Frame(0x123, b"\x01\x02\xff"), 1.5) == b"< frame 123 1.500000 0102FF >"
    assert frame_text(Frame(0x80), 1.5) == b"< frame 080 1.500000  >"
    assert frame_text(Frame(0x123, b"\x01", extended=True), 2.0) == b"< frame 00000123 2.000000 01 >"


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        ("123 3 1 ff a", Frame(0x123, b"\x01\xff\x0a")),
        ("00000123 1 0", Frame(0x123, b"\x00", extended=True)),
        ("080 0", Frame(0x080)),
        ("029 8", Frame(0x029, remote=True, length=8)),
    ],
)
def test_what_a_client_wants_sent_is_understood(text: str, frame: Frame) -> None:
    assert parse_send(text.split()) == frame


@pytest.mark.parametrize("text", ["", "123", "xyz 1 0", "800 1 0", "123 2 1", "123 9", "123 1 fff", "20000000 0"])
def test_what_is_no_frame_is_refused(text: str) -> None:
    with pytest.raises(SimulationError, match="not a frame"):
        parse_send(text.split())


# the wire, without a clock


def test_a_frame_has_as_many_bits_as_the_standard_says() -> None:
    assert Frame(0x555).bits == 47 + 1  # the zeros from the remote bit on make one run of five
    assert Frame(0x555, bytes([0x55] * 8)).bits == 111
    assert Frame(0, bytes(8)).bits > Frame(0x555, bytes([0x55] * 8)).bits
    assert Frame(0x1555_5555, bytes([0x55] * 8), extended=True).bits == 131


class Notes:
    """A referee that lets all pass, but for the ids it has to destroy."""

    def __init__(self) -> None:
        self.bad: set[int] = set()
        self.log: list[tuple[str, int, float]] = []

    def corrupts(self, sender: Station, frame: Frame) -> bool:
        return frame.can_id in self.bad

    def passed(self, sender: Station, frame: Frame, t: float) -> None:
        self.log.append(("passed", frame.can_id, t))

    def destroyed(self, sender: Station, frame: Frame, t: float) -> None:
        self.log.append(("destroyed", frame.can_id, t))

    def lost(self, sender: Station, frame: Frame, t: float) -> None:
        self.log.append(("lost", frame.can_id, t))


def station(wire: Wire) -> Station:
    made = Station("s", lambda frame, t: None)
    wire.attach(made)
    return made


def run(wire: Wire, until: float = inf) -> None:
    while (due := wire.next_due()) <= until and due < inf:
        wire.advance(due)


def test_of_frames_that_wait_the_lowest_id_goes_first() -> None:
    wire = Wire(1_000_000, notes := Notes())
    one, two = station(wire), station(wire)
    wire.send(one, Frame(0x700), 0.0)
    wire.send(two, Frame(0x123, extended=True), 0.00001)
    wire.send(one, Frame(0x201), 0.00001)
    wire.send(two, Frame(0x080), 0.00001)
    run(wire)
    # 700 had the wire already; each station keeps its own order, so 080 comes behind the extended frame
    assert [can_id for _, can_id, _ in notes.log] == [0x700, 0x123, 0x080, 0x201]


def test_frames_take_as_long_as_their_bits_one_after_the_other() -> None:
    wire = Wire(500_000, notes := Notes())
    one, _ = station(wire), station(wire)
    sent = [Frame(0x100 + k, bytes([0x55] * k)) for k in range(9)]
    for frame in sent:
        wire.send(one, frame, 10.0)
    run(wire)
    ends = [t for _, _, t in notes.log]
    assert [b - a for a, b in zip([10.0, *ends], ends, strict=False)] == pytest.approx([f.bits / 5e5 for f in sent])


def test_a_wire_that_was_not_looked_at_carried_no_less_meanwhile() -> None:
    wire = Wire(1_000_000, notes := Notes())
    one, _ = station(wire), station(wire)
    for k in range(10):
        wire.send(one, Frame(0x100), k * 0.001)
    run(wire, 1.0)
    assert [t for _, _, t in notes.log] == pytest.approx([k * 0.001 + Frame(0x100).bits / 1e6 for k in range(10)])


def test_a_destroyed_frame_is_sent_again_until_its_sender_is_bus_off() -> None:
    wire = Wire(1_000_000, notes := Notes())
    one, two = station(wire), station(wire)
    notes.bad = {0x100}
    wire.send(one, Frame(0x100), 0.0)
    run(wire, 0.0003)
    notes.bad.clear()
    run(wire)
    assert [what for what, _, _ in notes.log] == ["destroyed"] * 4 + ["passed"]
    assert one.errors == 4 * 8 - 1
    notes.bad = {0x100}
    wire.send(one, Frame(0x100), 1.0)
    wire.send(two, Frame(0x200), 1.0)
    run(wire)
    assert (one.off, two.off) == (True, False)
    assert notes.log[-1][0] == "destroyed"  # no node is left to acknowledge what the other wants to send
    third = station(wire)
    run(wire)
    assert notes.log[-1][:2] == ("passed", 0x200)
    assert not third.off


def test_unacknowledged_frames_wait_as_in_a_transmit_queue_and_leave_when_a_node_joins() -> None:
    wire = Wire(1_000_000, notes := Notes())
    one = station(wire)
    for k in range(12):
        wire.send(one, Frame(0x100 + k), 0.0)
    run(wire)
    assert [entry[:2] for entry in notes.log] == [("lost", 0x10A), ("lost", 0x10B)]
    station(wire)
    run(wire)
    assert [can_id for what, can_id, _ in notes.log if what == "passed"] == [0x100 + k for k in range(10)]
