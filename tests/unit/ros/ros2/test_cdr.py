"""Bytes of messages, against an encoder of another hand (pamoja-ros2)."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pamoja import ros2 as pamoja

from tests.support.ros2_processes import DEFINITIONS
from trade_gateway.ros_messages._types import Types

TYPES = Types(2, [DEFINITIONS])
numbers = st.floats(allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers)
TWIST = "geometry_msgs/msg/Twist"


@given(vectors, vectors)
def test_a_twist_has_the_bytes_that_another_package_gives_it(
    linear: tuple[float, float, float], angular: tuple[float, float, float]
) -> None:
    message = {"linear": dict(zip("xyz", linear, strict=True)), "angular": dict(zip("xyz", angular, strict=True))}
    written = TYPES.to_bytes(TWIST, message)
    assert written == bytes(pamoja.twist_to_cdr(linear, angular))
    assert pamoja.twist_from_cdr(list(written)) == (linear, angular)
    assert TYPES.from_bytes(TWIST, written) == message


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))
def test_whole_numbers_have_the_bytes_that_another_package_gives_them(sec: int, nanosec: int) -> None:
    writer = pamoja.CdrWriter()
    writer.write_i32(sec)
    writer.write_u32(nanosec)
    assert TYPES.to_bytes("builtin_interfaces/msg/Time", {"sec": sec, "nanosec": nanosec}) == bytes(writer.bytes)


@given(st.lists(numbers, max_size=4))
def test_numbers_of_a_list_are_aligned_as_by_another_package(data: list[float]) -> None:
    writer = pamoja.CdrWriter()
    for count in (0, 0, len(data)):  # of dimensions, the offset, of numbers: those begin at a multiple of 8
        writer.write_u32(count)
    for each in data:
        writer.write_f64(each)
    message = {"layout": {"dim": [], "data_offset": 0}, "data": data}
    assert TYPES.to_bytes("std_msgs/msg/Float64MultiArray", message) == bytes(writer.bytes)


def test_bytes_of_other_length_are_refused() -> None:
    with pytest.raises(ValueError, match="no geometry_msgs/msg/Twist"):
        TYPES.from_bytes(TWIST, bytes(20))
