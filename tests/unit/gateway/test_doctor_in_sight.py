"""What ``trade doctor`` says of the containers of the system: hubs, and hosts whose addresses changed."""

from collections.abc import Callable

import pytest

from trade import Container, where
from trade.transport.endpoints import free_endpoint
from trade.transport.interfaces import OwnAddress, own_addresses
from trade_gateway.cli.hardware import _doctor_host as host

pytestmark = pytest.mark.virtual_time


@pytest.mark.realtime
def test_a_container_whose_host_has_other_addresses_than_at_its_start_is_named(
    start_container: Callable[..., Container], monkeypatch: pytest.MonkeyPatch
) -> None:
    lan = {"system": "lab", "credentials": ("lab", "secret"), "insecure_lan": True}
    endpoint = free_endpoint()
    robot = start_container("rosie", listen=[endpoint.replace("127.0.0.1", "0.0.0.0")], **lan)
    member = start_container("member", connect=[endpoint], **lan)
    assert member.find(where(name="network", container="rosie"), wait_s=20)().listens == list(robot.settings.listen)
    assert not [found for found in host.in_sight(member, "lab") if found.level != "ok"]
    before = own_addresses()
    monkeypatch.setattr("trade.transport.zenoh_links.own_addresses", lambda: [*before, OwnAddress("10.9.0.9", 24, 2)])
    [found] = [found for found in host.in_sight(member, "lab") if found.level != "ok"]
    assert (found.level, found.about) == ("warning", "rosie")
    assert "other addresses than when it started" in found.text
    assert "by name" in found.fix


@pytest.mark.real_clock
def test_a_hub_that_has_ended_is_reported(system: str, start_container: Callable[..., Container]) -> None:
    member = start_container("member")
    assert [found.about for found in host.in_sight(member, system)] == [f"system {system}"]
    hub = start_container("hub", hub="serve")
    found = next(iter(host.in_sight(member, system)))
    assert (found.about, found.level) == ("hub", "ok")
    attached = start_container("attached")
    hub.close()
    found = next(iter(host.in_sight(member, system)))
    assert (found.about, found.level, found.fix.startswith("trade hub;")) == ("hub", "warning", True)
    lost = next(iter(host.in_sight(attached, system)))
    assert (lost.level, "(the hub of this host)" in lost.text) == ("error", True)
