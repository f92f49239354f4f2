"""Modbus RTU as the simulated gripper reads and writes it; frames by the manual's own examples."""

import pytest

from trade_hil_sim.robotiq import ExceptionCode, Request, RequestReader, crc16, frame
from trade_hil_sim.robotiq._protocol import GAP_S, PATIENCE_S, exception, read_answer, write_answer

pytestmark = pytest.mark.virtual_time

CLEAR = bytes.fromhex("091003E80003060000000000007330")
STATUS = bytes.fromhex("090307D00003040E")
STATUS_AS_INPUT = bytes.fromhex("090407D00003B1CE")


def only(data: bytes) -> Request | None:
    [request] = RequestReader().feed(data)
    return request


def test_the_check_sum_is_that_of_the_standard() -> None:
    assert crc16(b"123456789") == 0x4B37


def test_the_requests_of_the_manual_are_read() -> None:
    assert only(CLEAR) == Request(9, 0x10, write_at=0x03E8, values=(0, 0, 0))
    assert only(STATUS) == Request(9, 3, read_at=0x07D0, read_count=3)
    assert only(STATUS_AS_INPUT) == Request(9, 4, read_at=0x07D0, read_count=3)
    close = only(bytes.fromhex("091003E8000306090000FFFFFF4229"))
    assert close is not None
    assert close.values == (0x0900, 0x00FF, 0xFFFF)


def test_the_answers_are_those_of_the_manual() -> None:
    cleared, asked = only(CLEAR), only(STATUS_AS_INPUT)
    assert cleared is not None
    assert asked is not None
    assert write_answer(cleared).hex() == "091003e800030130"
    assert read_answer(asked, (0xB900, 0x00FF, 0xBD00)).hex() == "090406b90000ffbd005c9a"
    assert read_answer(asked, (0x1100,)).hex() == "0904021100" + "54a1"


def test_writing_one_register_and_writing_and_reading_at_once_are_read() -> None:
    one = frame(bytes.fromhex("09 06 03E8 0100"))
    both = frame(bytes.fromhex("09 17 07D0 0003 03E8 0002 04 0900 00FF"))
    assert only(one) == Request(9, 6, write_at=0x03E8, values=(0x0100,))
    assert only(both) == Request(9, 0x17, 0x07D0, 3, 0x03E8, (0x0900, 0x00FF))


def test_an_exception_has_the_functions_high_bit_and_the_code() -> None:
    asked = only(STATUS)
    assert asked is not None
    assert exception(asked, ExceptionCode.ADDRESS) == frame(bytes((9, 0x83, 2)))


@pytest.mark.parametrize("cut", range(1, len(CLEAR)))
def test_a_request_may_come_in_two_pieces(cut: int) -> None:
    reader = RequestReader()
    assert list(reader.feed(CLEAR[:cut])) == []
    reader.silence(GAP_S / 2)
    [request] = reader.feed(CLEAR[cut:])
    assert request == only(CLEAR)


def test_two_requests_in_one_piece_are_two() -> None:
    assert list(RequestReader().feed(CLEAR + STATUS)) == [only(CLEAR), only(STATUS)]


@pytest.mark.parametrize("place", range(len(STATUS)))
def test_a_damaged_request_is_nothing_and_all_up_to_the_next_silence_is_lost_with_it(place: int) -> None:
    reader = RequestReader()
    damaged = bytearray(STATUS)
    damaged[place] ^= 0x01
    found = list(reader.feed(bytes(damaged) + STATUS))
    assert only(STATUS) not in found
    reader.silence(2 * PATIENCE_S)
    assert list(reader.feed(STATUS)) == [only(STATUS)]


def test_half_a_request_is_given_up_after_a_silence() -> None:
    reader = RequestReader()
    assert list(reader.feed(CLEAR[:9])) == []
    reader.silence(2 * PATIENCE_S)
    assert list(reader.feed(STATUS)) == [only(STATUS)]


def test_contradicting_lengths_are_reported() -> None:
    wrong = frame(bytes.fromhex("09 10 03E8 0003 02 0900"))
    request = only(wrong)
    assert request is not None
    assert not request.whole
