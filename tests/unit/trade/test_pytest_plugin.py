"""The plug-ins for pytest, as a user runs them: `trade_system`, and no cost without it."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.pytest_runs import run_pytest

IN_MEMORY = """
from trade import errors, service, where
import pytest

class Oven:
    @service
    def heat(self, celsius: float) -> float:
        return celsius

kept = []

def test_the_cook_heats_the_oven(trade_system):
    kitchen, cook = trade_system.container("kitchen"), trade_system.container("cook")
    kitchen.register(Oven(), "kitchen.oven")
    assert cook.find(where(name="heat"))(180.0) == 180.0
    kept.append(cook)

def test_the_next_test_has_a_system_of_its_own(trade_system):
    with pytest.raises(errors.ConfigurationError, match="closed"):
        kept[0].services()
    assert trade_system.container("cook").services(where(group="kitchen")) == []
"""

IDLE = """
import sys

def test_it_does_without(pytestconfig):
    assert pytestconfig.pluginmanager.has_plugin("trade")
    assert pytestconfig.pluginmanager.has_plugin("trade_hil_sim")
    assert not {"trade", "trade_drivers", "trade_hil_sim", "zenoh", "msgspec"} & set(sys.modules)
"""


@pytest.mark.realtime
def test_each_test_gets_a_system_in_memory_that_is_closed_at_its_end(tmp_path: Path) -> None:
    assert "2 passed" in run_pytest(tmp_path, IN_MEMORY)


@pytest.mark.realtime
def test_a_run_that_uses_no_fixture_does_not_import_the_product(tmp_path: Path) -> None:
    assert "1 passed" in run_pytest(tmp_path, IDLE)


@pytest.mark.realtime
@pytest.mark.parametrize("package", ["trade", "trade_drivers", "trade_hil_sim"])
def test_the_product_does_not_import_pytest(package: str) -> None:
    program = f"import {package}, sys; sys.exit('pytest' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
