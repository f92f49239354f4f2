"""A pytest plug-in with the fixture `trade_system`. It imports trade only for tests that use the fixture.

It is a package beside ``trade``, as a module inside of it would import trade in every pytest run.
"""

from collections.abc import Generator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from trade.testing import MemorySystem

__all__ = ["trade_system"]


@pytest.fixture
def trade_system() -> "Generator[MemorySystem, None, None]":
    """A system in memory for one test: a `trade.testing.MemorySystem`, closed at the end."""
    from trade.testing import memory_system  # noqa: PLC0415 - see above

    with memory_system() as system:
        yield system
