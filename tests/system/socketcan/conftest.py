"""Virtual interfaces, and legs whose simulated drives sit on one, with candump beside them."""

import itertools
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from tests.system.socketcan.candump import Candump, RecordedLeg
from tests.system.socketcan.interfaces import ip, up
from tests.system.socketcan.slcan_adapter import SlcanAdapter
from tests.unit.drivers.legs import Leg

_numbers = itertools.count()


@contextmanager
def _made() -> Iterator[str]:
    name = f"vcan{next(_numbers)}"
    ip("link", "add", name, "type", "vcan")
    up(name)
    yield name
    subprocess.run(["ip", "link", "del", name], capture_output=True, check=False, timeout=20)  # the test may have


@pytest.fixture(scope="session")
def interface() -> Iterator[str]:
    """A virtual CAN interface for all tests that leave it as it is: to make one takes its time."""
    with _made() as name:
        yield name


@pytest.fixture
def own_interface() -> Iterator[str]:
    """One of the test's own."""
    with _made() as name:
        yield name


@pytest.fixture(scope="session")
def candump(interface: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Candump]:
    with Candump(interface, tmp_path_factory.mktemp("candump") / "log") as recording:
        yield recording


@pytest.fixture
def adapter(interface: str) -> Iterator[SlcanAdapter]:
    made = SlcanAdapter(interface)
    yield made
    made.close()


@pytest.fixture
def rig(interface: str) -> Iterator[Leg]:
    with ExitStack() as undo:
        yield Leg(undo, interface)


@pytest.fixture
def recorded(interface: str, candump: Candump) -> Iterator[RecordedLeg]:
    """The same, judged by candump's record."""
    candump.begin()
    with ExitStack() as undo:
        leg = RecordedLeg(undo, interface)
        leg.candump = candump
        yield leg
