"""Who comes and goes leaves nothing behind in those who stay, neither in Python nor in the transport beneath it."""

import ctypes
import itertools
from collections.abc import Callable
from typing import Any

import pytest

from trade import Container, where

WARM_UP, PASSERS, TIMES = 20, 20, 3
MOST_BYTES = 2500
"""Of each; the transport keeps 5 KiB or more of a link that it does not let go of."""

STAYING = """
    import ctypes, gc, time
    class Numbers(ctypes.Structure):
        _fields_ = [(name, ctypes.c_size_t) for name in
                    "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()]
    libc = ctypes.CDLL(None)
    libc.mallinfo2.restype = Numbers
    with Container(Settings.read(container="stays")) as staying:
        staying._parts.transport.settle()
        say("there")
        while hear():
            while len(staying._parts.registry.containers()) > 1:
                time.sleep(0.01)
            gc.collect()
            say(libc.mallinfo2().uordblks)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="what is in use is counted by glibc since 2.33")
def test_of_who_passes_by_nothing_is_kept(
    start_program: Callable[..., Any], start_container: Callable[..., Container], unwatched: str
) -> None:
    staying = start_program(STAYING, prelude=unwatched)
    assert staying.heard() == "there"

    def in_use_after(count: int) -> int:
        for number in range(count):
            with start_container(f"passes-{number}") as here:
                here.find(where(name="clock", container="stays"), wait_s=60)()
        staying.tell("how much is in use?")
        return int(staying.heard())

    in_use = [in_use_after(count) for count in (WARM_UP, *[PASSERS] * TIMES)]
    grown = [(after - before) / PASSERS for before, after in itertools.pairwise(in_use)]
    assert min(grown) < MOST_BYTES, grown  # now and then something else grows, too: a table, a cache
