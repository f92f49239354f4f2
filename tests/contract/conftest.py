"""The rig of each vendor, for rules that every vendor must keep."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from zlib import crc32

import pytest

from tests.contract.rigs.base import SafetyRig
from tests.contract.rigs.vendors import RIGS
from tests.unit.drivers.gate import Gate
from trade import Container


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.release()


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Runs a rule on the rigs of all vendors that it applies to; `make test` runs it on one of them."""
    if "rig" in metafunc.fixturenames:
        rule = metafunc.definition.originalname
        vendors = [vendor for vendor, made in RIGS.items() if rule not in made.lacks]
        quick = vendors[crc32(rule.encode()) % len(vendors)]  # another one for each rule, the same in each run
        rigs = [pytest.param(vendor, marks=[] if vendor == quick else [pytest.mark.slow]) for vendor in vendors]
        metafunc.parametrize("rig", rigs, indirect=True)


@pytest.fixture
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[SafetyRig]:
    with ExitStack() as undo:
        yield RIGS[request.param](undo, tmp_path)


@pytest.fixture
def driver(start_container: Callable[..., Container]) -> Container:
    return start_container("driver")


@pytest.fixture
def shared(rig: SafetyRig, gate: Gate, driver: Container) -> Iterator[SafetyRig]:
    """The rig, attached in a container."""
    rig.patient()
    rig.attach(register=driver.register, deregister=driver.deregister, healthy=gate)
    yield rig
    rig.robot.close()


@pytest.fixture
def planner(start_container: Callable[..., Container]) -> Container:
    return start_container("planner")


@pytest.fixture
def operator(start_container: Callable[..., Container]) -> Container:
    return start_container("operator")
