"""Protocol 2.0: the manual's packets, stuffing, and a reader that no stream of bytes confuses for long."""

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade_hil_sim.dynamixel import Instruction, Packet, PacketReader, crc16, encode, status
from trade_hil_sim.dynamixel._protocol import JoinedStatus, stuff, unstuff

pytestmark = pytest.mark.virtual_time

IDS = st.integers(0, 252) | st.just(254)
# plenty of what stuffing is about
PARAMS = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55]) | st.integers(0, 255), max_size=60).map(bytes)
PACKETS = st.builds(Packet, IDS, st.sampled_from(list(Instruction)).map(int), PARAMS)


@pytest.mark.parametrize(
    ("packet", "hexed"),
    [
        (encode(1, Instruction.PING), "FF FF FD 00 01 03 00 01 19 4E"),
        (encode(254, Instruction.PING), "FF FF FD 00 FE 03 00 01 31 42"),
        (status(1, 0, bytes([0x06, 0x04, 0x26])), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
        (status(2, 0, bytes([0x06, 0x04, 0x26])), "FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D"),
        (encode(1, Instruction.READ, bytes([132, 0, 4, 0])), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
        (status(1, 0, bytes([0xA6, 0, 0, 0])), "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
        (
            encode(1, Instruction.WRITE, bytes([116, 0, 0, 2, 0, 0])),
            "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
        ),
        (status(1, 0), "FF FF FD 00 01 04 00 55 00 A1 0C"),
        (
            encode(1, Instruction.REG_WRITE, bytes([104, 0, 0xC8, 0, 0, 0])),
            "FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E",
        ),
        (encode(1, Instruction.ACTION), "FF FF FD 00 01 03 00 05 02 CE"),
        (encode(1, Instruction.FACTORY_RESET, b"\x01"), "FF FF FD 00 01 04 00 06 01 A1 E6"),
        (encode(1, Instruction.REBOOT), "FF FF FD 00 01 03 00 08 2F 4E"),
        (encode(1, Instruction.CLEAR, b"\x01DXL\x22"), "FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC"),
        (
            encode(254, Instruction.SYNC_READ, bytes([132, 0, 4, 0, 1, 2])),
            "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
        ),
        (
            encode(254, Instruction.SYNC_WRITE, bytes([116, 0, 4, 0, 1, 0x96, 0, 0, 0, 2, 0xAA, 0, 0, 0])),
            "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
        ),
        (
            encode(254, Instruction.BULK_READ, bytes([1, 0x90, 0, 2, 0, 2, 0x92, 0, 1, 0])),
            "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
        ),
    ],
)
def test_packets_are_those_of_the_manual(packet: bytes, hexed: str) -> None:
    assert packet == bytes.fromhex(hexed)


def test_the_crc_has_its_known_check_value_and_continues_from_a_part() -> None:
    assert crc16(b"123456789") == 0xFEE8
    assert crc16(b"6789", crc16(b"12345")) == 0xFEE8


def test_a_header_inside_a_packet_is_stuffed_in_length_and_crc() -> None:
    packet = encode(1, Instruction.WRITE, bytes([84, 0, 0xFF, 0xFF, 0xFD, 0x00]))
    assert packet == bytes.fromhex("FF FF FD 00 01 0A 00 03 54 00 FF FF FD FD 00 22 45")
    assert PacketReader().feed(packet) == [Packet(1, 3, bytes([84, 0, 0xFF, 0xFF, 0xFD, 0x00]))]


def test_a_packet_that_should_have_been_stuffed_is_lost_and_the_next_is_read() -> None:
    unstuffed = bytes.fromhex("FF FF FD 00 01 09 00 03 54 00 FF FF FD 00 E8 87")
    reader = PacketReader()
    assert reader.feed(unstuffed + encode(2, Instruction.PING)) == [Packet(2, 1, b"")]
    assert reader.skipped == len(unstuffed)


def test_a_wrong_crc_is_reported_not_hidden() -> None:
    packet = bytearray(encode(1, Instruction.PING))
    packet[-1] ^= 0xFF
    assert PacketReader().feed(bytes(packet)) == [Packet(1, 1, b"", intact=False)]


def test_a_joined_answer_ends_each_block_with_the_crc_of_all_before_it() -> None:
    joined = JoinedStatus(data_bytes=8, blocks=2)
    joined.add(1, 0, bytes([0xA6, 0, 0, 0]))
    joined.add(2, 0x80, bytes([0x1F, 8, 0, 0]))
    whole = bytes(joined)
    assert whole[:8] == bytes.fromhex("FF FF FD 00 FE 11 00 55")
    assert len(whole) == 7 + 0x11
    assert int.from_bytes(whole[14:16], "little") == crc16(whole[:14])
    assert int.from_bytes(whole[-2:], "little") == crc16(whole[:-2])


@given(st.binary())
def test_stuffing_and_unstuffing_are_inverse(body: bytes) -> None:
    assert unstuff(stuff(body)) == body
    assert b"\xff\xff\xfd\x00" not in stuff(body)


@given(PACKETS)
def test_encoding_and_decoding_are_inverse(packet: Packet) -> None:
    assert PacketReader().feed(encode(packet.device_id, packet.instruction, packet.params)) == [packet]


@given(st.lists(PACKETS, max_size=5), st.data())
def test_packets_are_read_wherever_the_chunks_break(packets: list[Packet], data: st.DataObject) -> None:
    stream = b"".join(encode(p.device_id, p.instruction, p.params) for p in packets)
    reader = PacketReader()
    read = [packet for chunk in _chunks(stream, data) for packet in reader.feed(chunk)]
    assert read == packets
    assert reader.skipped == 0


@given(st.lists(st.binary(max_size=20) | PARAMS | PACKETS, max_size=8), st.data())
def test_any_bytes_in_any_chunks_read_alike(parts: list[bytes | Packet], data: st.DataObject) -> None:
    stream = b"".join(p if isinstance(p, bytes) else encode(p.device_id, p.instruction, p.params) for p in parts)
    whole, piecewise = PacketReader(), PacketReader()
    expected = whole.feed(stream)
    read = [packet for chunk in _chunks(stream, data) for packet in piecewise.feed(chunk)]
    assert read == expected
    assert piecewise.skipped == whole.skipped


@given(st.binary(max_size=40))
def test_after_noise_and_a_pause_the_next_packet_is_read(noise: bytes) -> None:
    reader = PacketReader()
    reader.feed(noise)
    reader.reset()
    assert reader.feed(encode(7, Instruction.PING)) == [Packet(7, 1, b"")]


def _chunks(stream: bytes, data: st.DataObject) -> Iterator[bytes]:
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        yield stream[:size]
        stream = stream[size:]
