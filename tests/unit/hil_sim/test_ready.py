"""Waiting for files whose numbers are as large as those of a process with many of them open."""

import fcntl
import os
import resource
from collections.abc import Iterator

import pytest

from trade_hil_sim.robot._bus_thread import ready

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """A pipe whose ends have numbers that ``select`` refuses."""
    if resource.getrlimit(resource.RLIMIT_NOFILE)[0] < 2048:
        pytest.skip("this process may not have so many files open")
    small = os.pipe()
    large = [fcntl.fcntl(end, fcntl.F_DUPFD, 1500) for end in small]
    yield large[0], large[1]
    for end in (*small, *large):
        os.close(end)


@pytest.mark.real_clock
def test_readable_state_is_reported_and_the_rest_waited_for(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    assert ready([reading], timeout_s=0.0) == []
    assert ready([reading], [writing], timeout_s=60.0) == []  # it came back, because one can write
    os.write(writing, b"x")
    assert ready([reading], timeout_s=60.0) == [reading]


def test_the_end_of_the_other_side_can_be_read_too() -> None:
    reading, writing = os.pipe()
    os.close(writing)
    assert ready([reading], timeout_s=60.0) == [reading]
    os.close(reading)
