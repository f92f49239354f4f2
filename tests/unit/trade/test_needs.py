"""Pre-conditions: found, shown and sent like post-conditions, from containers of every age; they refuse no call."""

from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from tests.unit.trade.forged_messages import FORGED, PROVIDER
from trade import Container, Handle, service, where
from trade.protocol.keys import alive_key, registry_key
from trade.protocol.messages import encode_message
from trade.testing import memory_system


class Arm:
    def __init__(self) -> None:
        self.held: list[str] = []

    @service(needs=["see(?thing)", "at(?place)"], achieves=["holding(?thing)"])
    def pick_up(self, thing: str) -> None:
        """Close the gripper around it."""
        self.held.append(thing)

    @service(needs="holding(cup)", achieves=["holding(cup)", "at(?anywhere)"])
    def carry(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture
def arm() -> Arm:
    return Arm()


@pytest.fixture
def asker(arm: Arm) -> Iterator[Container]:
    with memory_system() as system:
        system.container("robot").register(arm, "rosie.arm")
        asker = system.container("asker")
        system.settle()
        yield asker


def names(found: list[Handle]) -> list[str]:
    return sorted(handle.name for handle in found)


FOUND = [
    (where(needs="see(?x)"), ["pick_up"]),
    (where(needs="see(mug)"), ["pick_up"]),
    (where(needs=["see(mug)", "at(dock)"]), ["pick_up"]),
    (where(needs=["see(mug)", "holding(mug)"]), []),
    (where(needs="holding(?x)"), ["carry"]),
    (where(needs="holding(mug)"), []),
    (where(needs="holding(?x)", achieves="holding(?x)"), ["carry"]),
    (where(achieves="holding(?x)") & ~where(needs="holding(?x)"), ["pick_up"]),
    (where(needs="at(dock)") | where(needs="holding(cup)"), ["carry", "pick_up"]),
]


@pytest.mark.parametrize(("constraint", "found"), FOUND, ids=str)
def test_services_are_found_by_what_they_need(asker: Container, constraint: Any, found: list[str]) -> None:
    assert names(asker.services(constraint & where(group="rosie"))) == found


def test_a_handle_shows_what_its_service_needs_and_achieves(asker: Container) -> None:
    pick_up = asker.find(where(name="pick_up"))
    assert (pick_up.needs, pick_up.achieves) == (("see(?thing)", "at(?place)"), ("holding(?thing)",))
    assert str(pick_up.__doc__).endswith("around it.\n\nneeds see(?thing), at(?place); achieves holding(?thing)")
    stop = asker.find(where(name="stop", group="rosie"))
    assert (stop.needs, stop.__doc__) == ((), "stop() -> None")


def test_an_unmet_pre_condition_refuses_no_call(asker: Container, arm: Arm) -> None:
    assert asker.services(where(achieves="see(?x)")) == []
    asker.call(where(name="pick_up"), "mug")
    assert arm.held == ["mug"]


OTHERS = {
    "older": ({}, (), False),
    "newer": ({"needs": ["see(?x)"], "forbids": [["rain", 1]]}, ("see(?x)",), True),
    "malformed": ({"needs": ["((", "?x", ""]}, ("((", "?x", ""), False),
    "malformed beside others": ({"needs": ["((", "see(cup)"]}, ("((", "see(cup)"), True),
}


@pytest.mark.parametrize(("fields", "needs", "found"), OTHERS.values(), ids=list(OTHERS))
def test_a_container_of_any_age_is_understood(
    here: Container, open_raw: Any, fields: dict[str, Any], needs: tuple[str, ...], found: bool
) -> None:
    entry = msgspec.msgpack.decode(encode_message(PROVIDER))
    assert "needs" not in entry["services"][0], "without pre-conditions an entry is as it was before there were any"
    entry["services"][0].update(fields)
    raw = open_raw(here)
    sign, registry = raw.appear(alive_key(FORGED)), here._parts.registry
    assert registry.wait_for(lambda: registry.is_alive(FORGED), 20)
    raw.announce(registry_key("robot", FORGED, "P-1"), encode_message(entry))
    assert here.find(where(group="forged"), wait_s=20).needs == needs
    assert bool(here.services(where(needs="see(?x)"))) is found
    assert here.dropped_messages == 0
    sign.close()
