"""The rig of each vendor, for rules that every vendor must keep."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.contract.rigs.base import SafetyRig
from tests.contract.rigs.differences import DIFFERENCES, Difference
from tests.contract.rigs.vendors import RIGS
from tests.unit.drivers.gate import Gate
from trade import Container


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.release()


_OWN_TIME = {"ur"}
"""Vendors whose library is in C, and keeps its own time."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Runs a rule on the rigs of all vendors that it applies to, on virtual time where that is possible."""
    if "difference" in metafunc.fixturenames:
        named = [(vendor, question, one) for vendor, of in DIFFERENCES.items() for question, one in of.items()]
        rows = [
            pytest.param(vendor, one, id=f"{vendor}-{question}", marks=pytest.mark.virtual_time)
            for vendor, question, one in named
            if isinstance(one, Difference)
        ]
        metafunc.parametrize(("rig", "difference"), rows, indirect=["rig"])
    elif "rig" in metafunc.fixturenames:
        rule = metafunc.definition.originalname
        vendors = [vendor for vendor, made in RIGS.items() if rule not in made.lacks]
        marks = [pytest.mark.realtime if vendor in _OWN_TIME else pytest.mark.virtual_time for vendor in vendors]
        rigs = [pytest.param(vendor, marks=mark) for vendor, mark in zip(vendors, marks, strict=True)]
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
