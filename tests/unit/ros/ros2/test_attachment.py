"""What travels beside messages."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh.ext import Int64, UInt8, z_serialize
from zenoh_ros2_sdk.attachment import Attachment as Theirs

from trade_gateway.ros.ros2._node import Attachment

longs = st.integers(-(2**63), 2**63 - 1)
gids = st.binary(min_size=16, max_size=16)
EXAMPLE = bytes.fromhex("0807060504030201 1817161514131211 10 00112233445566778899aabbccddeeff")


def test_the_layout_is_that_of_rmw_zenoh() -> None:
    gid = bytes.fromhex("00112233445566778899aabbccddeeff")
    assert Attachment(0x0102030405060708, 0x1112131415161718, gid).to_bytes() == EXAMPLE


@given(longs, longs, gids)
def test_what_is_written_is_read_again(sequence: int, time_ns: int, gid: bytes) -> None:
    attachment = Attachment(sequence, time_ns, gid)
    assert Attachment.from_bytes(attachment.to_bytes()) == attachment


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), gids)
def test_another_package_writes_the_same(sequence: int, time_ns: int, gid: bytes) -> None:
    theirs = Theirs(sequence, time_ns, gid).to_bytes()
    assert Attachment(sequence, time_ns, gid).to_bytes() == theirs
    assert Theirs.from_bytes(theirs) == Theirs(*Attachment.from_bytes(theirs))


@given(longs, longs, gids)
def test_the_serializer_of_zenoh_writes_the_same(sequence: int, time_ns: int, gid: bytes) -> None:
    written = z_serialize(Int64(sequence)), z_serialize(Int64(time_ns)), z_serialize([UInt8(each) for each in gid])
    assert Attachment(sequence, time_ns, gid).to_bytes() == b"".join(map(zenoh.ZBytes.to_bytes, written))


@given(st.binary(max_size=64))
def test_other_bytes_are_refused_with_a_reason(data: bytes) -> None:
    try:
        read = Attachment.from_bytes(data)
    except ValueError as refused:
        assert "bytes, not" in str(refused)
    else:
        assert read.to_bytes() == data


@pytest.mark.parametrize("length", [0, 15, 17, 255])
def test_a_gid_of_another_length_is_refused(length: int) -> None:
    with pytest.raises(ValueError, match=f"16 bytes, not {length}"):
        Attachment.from_bytes(EXAMPLE[:16] + bytes([length]) + EXAMPLE[17:])
