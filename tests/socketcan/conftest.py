"""Virtual interfaces, and legs whose simulated drives sit on one."""

import itertools
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from drivers.legs import Leg

_numbers = itertools.count()


def ip(*words: str) -> None:
    """Runs ``ip WORDS``; raises CalledProcessError."""
    subprocess.run(["ip", *words], capture_output=True, text=True, check=True, timeout=20)


@pytest.fixture
def interface() -> Iterator[str]:
    """A virtual CAN interface of the test's own."""
    name = f"vcan{next(_numbers)}"
    ip("link", "add", name, "type", "vcan")
    ip("link", "set", name, "up")
    yield name
    subprocess.run(["ip", "link", "del", name], capture_output=True, check=False, timeout=20)  # the test may have


@pytest.fixture
def rig(interface: str) -> Iterator[Leg]:
    with ExitStack() as undo:
        yield Leg(undo, interface)
