"""The middleware's own functions are part of the protocol: what they answer does not depend on who describes them."""

import pytest
from msgspec import structs

from tests.support.waiting import wait_until
from trade import Container, Resource, service, where
from trade.protocol.messages import NO_SCHEMA, ProviderInfo
from trade.testing import memory_system

pytestmark = pytest.mark.virtual_time


class Joint:
    def __init__(self) -> None:
        self.resources = [Resource("joint")]

    @service
    def move(self, value: float) -> float:
        return value

    @service(effect="stop")
    def stop(self) -> None: ...


def _say_nothing_of_results(container: Container) -> None:
    """As a container in another language does."""

    def bare(info: ProviderInfo) -> ProviderInfo:
        return structs.replace(
            info, services=tuple(structs.replace(one, result_schema=NO_SCHEMA, types={}) for one in info.services)
        )

    parts = container._parts
    for place in ("trade/system", "trade/estops"):
        offer = parts.providers.offer(place)
        assert offer is not None
        parts.providers.alter(offer.provider, bare)


def test_a_container_that_does_not_say_what_its_own_functions_answer_can_be_locked() -> None:
    with memory_system() as system:
        there, here = system.container("there"), system.container("here")
        there.register(Joint(), "robot")
        _say_nothing_of_results(there)
        acquire = here.find(where(name="acquire", container="there"))
        wait_until(lambda: acquire.schema["result"] == {}, "the bare description came")
        move = here.find(where(name="move"))
        with here.lock(where(group="robot"), purpose="to move it") as lock:
            assert lock.resources == ("joint",)
            assert move(0.5) == 0.5
            assert [info.holder.purpose for info in here.locks()] == ["to move it"]
