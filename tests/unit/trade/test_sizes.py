"""Large arguments and results: what passes, and that what is too large is refused before a byte is sent."""

from typing import Any

import pytest

from trade import Container, service, where
from trade.errors import TooLarge
from trade.protocol.messages import MOST_BYTES

pytestmark = pytest.mark.virtual_time

MIB = 1 << 20


class Store:
    calls = 0

    @service
    def echo(self, data: bytes) -> bytes:
        self.calls += 1
        return data

    @service(effect="read")
    def make(self, size: int) -> bytes:
        return bytes(size)


def test_sixteen_mebibytes_pass_both_ways(offer: Any) -> None:
    data = bytes(16 * MIB)
    assert offer(Store())("echo").with_(deadline_s=60)(data) == data


def test_arguments_beyond_the_limit_are_refused_and_not_a_byte_is_sent(offer: Any) -> None:
    store = Store()
    echo = offer(store)("echo")
    with pytest.raises(
        TooLarge, match=r"robot.echo: arguments of 64.0 MiB .* cannot be sent. The limit is 64 MiB"
    ) as e:
        echo(bytes(MOST_BYTES))
    assert e.value.size_bytes > e.value.limit_bytes == MOST_BYTES
    with pytest.raises(ValueError, match="Send smaller parts"):
        echo.start(bytes(MOST_BYTES))
    assert store.calls == 0


def test_a_result_beyond_the_limit_is_an_error_of_the_call(here: Container, there: Container) -> None:
    there.register(Store(), "robot")
    make = here.find(where(name="make"), wait_s=20)
    with pytest.raises(TooLarge, match=r"robot.make: a result of 64.0 MiB"):
        make(MOST_BYTES)
    assert make(1) == b"\0"
