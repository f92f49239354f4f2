"""The rig of each vendor, for rules that every vendor must keep."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.contract.rigs.base import SafetyRig
from tests.contract.rigs.vendors import RIGS
from tests.unit.drivers.gate import Gate
from trade import Container


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.let_go()


@pytest.fixture(params=RIGS)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[SafetyRig]:
    made = RIGS[request.param]
    rule = request.node.originalname
    if reason := made.lacks.get(rule):
        pytest.skip(f"{rule} does not apply to {request.param}: {reason}")
    with ExitStack() as undo:
        yield made(undo, tmp_path)


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
