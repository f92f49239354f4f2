"""Who comes and goes leaves nothing behind in those who stay, neither in Python nor in the transport beneath it."""

import ctypes
import itertools
import json
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from trade import Container, where
from trade.transport.credentials import user_secret

pytestmark = pytest.mark.realtime

WARM_UP, PASSERS, TIMES = 20, 20, 5
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
        say(str(staying._parts.transport.links.listen[0]))
        while hear():
            while len(staying._parts.registry.containers()) > 1:
                time.sleep(0.01)
            gc.collect()
            say(libc.mallinfo2().uordblks)
"""


NEEDS_GLIBC = pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="what is in use is counted by glibc since 2.33"
)


@NEEDS_GLIBC
def test_nothing_is_kept_of_short_lived_containers(
    start_program: Callable[..., Any], start_container: Callable[..., Container], unwatched: str
) -> None:
    staying = start_program(STAYING, prelude=unwatched)
    assert staying.heard()

    numbers = itertools.count()

    def pass_by() -> None:
        with start_container(f"passes-{next(numbers)}") as here:
            here.find(where(name="clock", container="stays"), wait_s=60)()

    grown = growth(staying, pass_by)
    assert min(grown) < MOST_BYTES, grown  # now and then something else grows, too: a table, a cache


@NEEDS_GLIBC
def test_nothing_is_kept_of_a_silent_session_of_the_transport(
    start_program: Callable[..., Any], unwatched: str
) -> None:
    staying = start_program(STAYING, prelude=unwatched)
    endpoint = staying.heard()
    user, password = user_secret()
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "transport/auth/usrpwd": {"user": user, "password": password},
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))

    def pass_by() -> None:
        with zenoh.open(config) as session:
            assert list(session.info.routers_zid()) or list(session.info.peers_zid())

    grown = growth(staying, pass_by)
    assert min(grown) < MOST_BYTES, grown


def growth(staying: Any, pass_by: Callable[[], None]) -> list[float]:
    """By how many bytes a running container grows with each short-lived one, in each batch after the first one."""

    def in_use_after(count: int) -> int:
        for _ in range(count):
            pass_by()
        staying.tell("how much is in use?")
        return int(staying.heard())

    in_use = [in_use_after(count) for count in (WARM_UP, *[PASSERS] * TIMES)]
    return [(after - before) / PASSERS for before, after in itertools.pairwise(in_use)]
