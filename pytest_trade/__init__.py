"""A pytest plug-in with the fixture `trade_system` and the marker `virtual_time`.

It imports trade only for tests that use them. It is a package beside ``trade``,
as a module inside of it would import trade in every pytest run.
"""

from collections.abc import Generator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from trade.testing import MemorySystem

__all__ = ["trade_system"]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of virtual time."""
    group = parser.getgroup("trade")
    group.addoption("--seed", type=int, help="the seed of all tests on virtual time, instead of their own")
    group.addoption("--real-time", action="store_true", help="run tests that are marked virtual_time on the real clock")


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers."""
    for line in (
        "virtual_time(seed=0, switch=0.02, packages=()): run the test and its function-scoped fixtures on virtual time",
        "real_clock: keep the test on the real clock, whatever its module says",
    ):
        config.addinivalue_line("markers", line)


@pytest.fixture(autouse=True)
def _virtual_time(request: pytest.FixtureRequest) -> Generator[None, None, None]:
    marker = request.node.get_closest_marker("virtual_time")
    real = request.config.getoption("--real-time") or request.node.get_closest_marker("real_clock")
    if marker is None or real:
        yield
        return
    from trade.testing import virtual_time  # noqa: PLC0415 - see above

    modules: list[str] = [request.node.module.__name__, request.function.__module__, "conftest"]
    packages = [*(name.partition(".")[0] for name in modules), *marker.kwargs.get("packages", ())]
    wanted: dict[str, Any] = {"seed": 0, **marker.kwargs, "packages": packages}
    if (seed := request.config.getoption("--seed")) is not None:
        wanted["seed"] = seed
    with virtual_time(**wanted):
        yield


@pytest.fixture
def trade_system() -> "Generator[MemorySystem, None, None]":
    """A system in memory for one test: a `trade.testing.MemorySystem`, closed at the end."""
    from trade.testing import memory_system  # noqa: PLC0415 - see above

    with memory_system() as system:
        yield system
