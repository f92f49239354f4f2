"""What others see and a container does not: said with the addresses that were tried, and never guessed."""

from collections.abc import Iterator
from typing import cast

import pytest

from tests.unit.trade.joint_with_policy import Neck
from trade import Container
from trade._calls.reachability import beyond
from trade._discovery.dialer import Dialer
from trade.errors import NoSuchService
from trade.testing import MemorySystem, memory_system
from trade.transport.addresses import Attempt

pytestmark = pytest.mark.virtual_time
LEASE_S = 2.0


@pytest.fixture
def system() -> Iterator[MemorySystem]:
    with memory_system(lease_s=LEASE_S) as made:
        yield made


@pytest.fixture
def here(system: MemorySystem) -> Container:
    """It sees ``base``, which sees ``rosie`` and a client."""
    robot, here = system.container("rosie"), system.container("here")
    robot.register(Neck(), "rosie.neck")
    for other in (system.container("client"), robot):
        system.partition(here, other)
    system.advance(LEASE_S)
    system.container("base")
    system.settle()
    return here


class Tried:
    """Links of a container that has tried addresses."""

    def attempts(self) -> list[Attempt]:
        return [
            Attempt("tcp/172.17.0.1:7450", "timed out", 1.0),
            Attempt("tcp/10.9.0.5:7450", "refused", 1.0),
            Attempt("tcp/10.9.0.6:7450", "", 1.0),
        ]


def test_what_another_container_sees_is_said_until_there_is_a_link(system: MemorySystem, here: Container) -> None:
    [said] = here.beyond()
    count = next(info.services for info in system.container("base").containers() if info.name == "rosie")
    assert said == f"base sees rosie ({count} services); no link from here yet"
    system.heal()
    system.settle()
    assert here.beyond() == []


def test_the_addresses_that_were_tried_in_vain_are_said(here: Container) -> None:
    [said] = beyond(here.registry, cast("Dialer", Tried()), here.handle)
    assert said.endswith("no link from here yet: tried 172.17.0.1:7450 (timed out), 10.9.0.5:7450 (refused)")


def test_a_lookup_that_finds_nothing_says_who_sees_more(here: Container) -> None:
    with pytest.raises(NoSuchService, match=r"base sees rosie \(\d+ services\); no link from here yet"):
        here.find("rosie.neck.angle", wait_s=0.5)
    with pytest.raises(NoSuchService, match="No services are registered"):  # control: it does not ask without a wait
        here.find("rosie.neck.angle", wait_s=0)
