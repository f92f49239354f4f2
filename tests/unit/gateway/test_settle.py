"""Garbage collections skip the objects of a robot that is up, and its memory stays: its bus threads would wait."""

import gc
import platform
import subprocess
import sys
from collections.abc import Iterator

import pytest

from trade_gateway.process._signals import settle

pytestmark = pytest.mark.virtual_time


@pytest.fixture(autouse=True)
def _thaw() -> Iterator[None]:
    yield
    gc.unfreeze()


def test_existing_objects_are_left_out_of_collections_and_later_ones_are_not() -> None:
    stood = len(gc.get_objects())
    settle()
    assert len(gc.get_objects()) < stood / 20
    later = [[] for _ in range(1000)]  # type: ignore[var-annotated]
    assert len(gc.get_objects()) > len(later)


PICTURES = """
import resource
from trade_gateway.process._signals import settle

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        kept = [bytes(2 << 20) for _ in range(4)]  # what a call with a picture takes at the same time
        del kept
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

first = faults()
settle()
faults()
print(first, faults())
"""


@pytest.mark.realtime
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs mallopt of glibc")
def test_memory_that_is_used_again_costs_no_page_faults() -> None:
    done = subprocess.run([sys.executable, "-c", PICTURES], capture_output=True, text=True, timeout=60, check=True)
    before, after = map(int, done.stdout.split())
    assert after < before / 100
