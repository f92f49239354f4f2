"""Shared memory of the transport is for what is large: a pool is 16 MiB of locked memory that the process keeps."""

from typing import Any

import pytest

from trade import Container, where

pytestmark = pytest.mark.realtime

OFFERS = """
    class Lamp:
        @service(effect="read")
        def brightness(self, room: str = "hall", at_s: float = 0.0, unit: str = "candela") -> float:
            "How bright it is."
            return 0.5
        @service(effect="read")
        def picture(self) -> bytes:
            return bytes(1 << 20)
    for number in range(40):
        trade.register(Lamp(), f"house.room{number}")
    def locked_kib():
        return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmLck"))
    hear()
    say(locked_kib())
    hear()
    say(locked_kib())
"""


@pytest.mark.usefixtures("no_local_path")
def test_announcing_many_services_takes_no_pool_and_a_large_result_does(here: Container, start_program: Any) -> None:
    program = start_program(OFFERS)
    handle = here.find(where(name="picture", group="house.room39"), wait_s=30)
    program.tell()
    reported = int(program.heard())
    assert reported < 4096
    handle()
    program.tell()
    assert int(program.heard()) > reported + 4096  # it would be seen
