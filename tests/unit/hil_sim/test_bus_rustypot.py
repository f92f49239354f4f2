"""A client that shares no code with the vendor's drives the simulated bus, and stuffs what it sends."""

from collections.abc import Iterator
from typing import Any

import pytest
import rustypot

from tests.support.waiting import wait_until
from trade_hil_sim import DynamixelBus, writes

pytestmark = pytest.mark.realtime


@pytest.fixture
def client(bus: DynamixelBus) -> Iterator[Any]:
    client = rustypot.Xl430PyController(str(bus.port), 1_000_000, 2.0)
    yield client
    client.close()


def test_ping_scan_read_write(client: Any) -> None:
    assert client.ping(1)
    assert set(client.scan([1, 2, 3])) == {1, 2, 3}
    assert client.read_present_position(1) == [2048]
    client.write_led(2, 1)
    assert client.read_led(2) == [1]


def test_sync_read_and_sync_write(client: Any, bus: DynamixelBus) -> None:
    client.sync_write_goal_position([1, 2, 3], [2001, 2002, 2003])
    assert client.sync_read_goal_position([3, 1, 2]) == [2003, 2001, 2002]
    assert [e.device_id for e in writes(bus.log.entries, register="goal_position")] == [1, 2, 3]


def test_fast_sync_read(client: Any, bus: DynamixelBus) -> None:
    client.set_fast_sync_read(True)
    assert client.sync_read_present_position([1, 2, 3]) == [2048] * 3
    assert [e.name for e in bus.log.entries if e.kind == "instruction"] == ["fast_sync_read"]


def test_data_that_looks_like_a_header_passes_in_both_directions(client: Any) -> None:
    """FF FF FD 00 as data; stuffed by both ends."""
    for k, byte in enumerate((0xFF, 0xFF, 0xFD, 0x00)):
        client.write_raw_data(1, 224 + k, [byte])
    client.write_raw_data(1, 228, [0xFF, 0xFF, 0xFD, 0x00])
    assert list(client.read_raw_data(1, 224, 8)) == [0xFF, 0xFF, 0xFD, 0x00] * 2


def test_reboot(client: Any) -> None:
    client.write_led(1, 1)
    client.reboot(1)
    client.set_timeout(0.1)
    wait_until(lambda: client.ping(1), "the servo after its reboot")
    assert client.read_led(1) == [0]


def test_an_absent_id_in_a_sync_read_spoils_it(client: Any) -> None:
    with pytest.raises(RuntimeError):
        client.sync_read_present_position([1, 9, 2])
