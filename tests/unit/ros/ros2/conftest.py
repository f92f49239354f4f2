"""A router, and our graph and another's node at it. Each module has its own router; each test what it opens."""

from collections.abc import Callable, Iterator
from typing import Any

import hypothesis
import pytest
import zenoh

from tests.support.ros2_processes import DEFINITIONS, Process, Router, closing_all, free_port, raw_session
from tests.support.waiting import wait_until
from trade_gateway.ros.ros2 import Ros2

hypothesis.settings.register_profile("deterministic", deadline=None, derandomize=True, max_examples=60)
hypothesis.settings.load_profile("deterministic")


@pytest.fixture(scope="module")
def _shared_router() -> Iterator[Router]:
    router = Router(free_port())
    router.start()
    yield router
    router.kill()


@pytest.fixture(scope="module")
def _shared_peer(_shared_router: Router) -> Iterator[Process]:
    port = _shared_router.endpoint.rpartition(":")[2]
    peer = Process("ros2_sdk_node", port, "sdk")
    yield peer
    peer.close()


@pytest.fixture
def router(_shared_router: Router) -> Router:
    """One for all tests of the module; it stays."""
    return _shared_router


@pytest.fixture
def peer(_shared_peer: Process) -> Process:
    """A node of another package, ``/sdk``, for all tests of the module; it stays."""
    return _shared_peer


@pytest.fixture
def own_router() -> Iterator[Router]:
    """One of the test's own, not yet started."""
    router = Router(free_port())
    yield router
    router.kill()


@pytest.fixture
def start_peer() -> Iterator[Callable[[Router, str], Process]]:
    """Starts a node of another package at a router."""
    with closing_all() as keep:
        yield lambda router, name: keep(Process("ros2_sdk_node", router.endpoint.rpartition(":")[2], name))


@pytest.fixture
def open_graph() -> Iterator[Callable[..., Ros2]]:
    """Opens graphs of TRADE at a router."""
    with closing_all() as keep:

        def opened(router: Router, node: str = "/trade", **settings: Any) -> Ros2:
            return keep(Ros2(router.endpoint, node=node, folders=[DEFINITIONS], **settings))

        yield opened


@pytest.fixture
def graph(router: Router, open_graph: Callable[..., Ros2]) -> Ros2:
    """Ours, at the shared router."""
    ours = open_graph(router)
    wait_until(lambda: not ours.healthy, "our graph has found the router")
    return ours


@pytest.fixture
def raw(router: Router) -> Iterator[zenoh.Session]:
    with raw_session(router) as session:
        yield session


@pytest.fixture
def other(router: Router, open_graph: Callable[..., Ros2]) -> Ros2:
    """Ours, once more."""
    return open_graph(router, node="/client")
