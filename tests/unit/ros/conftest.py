"""What the tests of the ROS bridge stand on."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.ros.robots import Stand
from trade.testing import memory_system


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    with memory_system() as memory:
        made = Stand(memory, tmp_path)
        try:
            yield made
        finally:
            made.close()
