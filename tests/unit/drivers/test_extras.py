"""An installation without any extra: no library of a vendor is installed, and nothing but its drivers needs it."""

import subprocess
import sys
from importlib.metadata import requires

import pytest
from packaging.requirements import Requirement

pytestmark = pytest.mark.virtual_time

MODULES = {"cffi", "can", "canopen", "dynamixel_sdk", "serial", "pymodbus", "rtde_control"}
"""What the libraries of the extras are imported as."""
LIBRARIES = {"cffi", "python-can", "canopen", "dynamixel-sdk", "pyserial", "pymodbus", "ur-rtde", "trade-drivers"}

WITHOUT = f"""
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted(MODULES)}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
"""


@pytest.mark.realtime
@pytest.mark.parametrize("module", ["trade_drivers", "trade_drivers.testing", "trade_hil_sim"])
def test_a_package_is_imported_without_the_libraries_of_its_extras(module: str) -> None:
    program = f"{WITHOUT}\nimport {module}"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stderr


def test_these_are_all_extras() -> None:
    optional = [Requirement(text) for text in requires("trade-drivers") or [] if "extra ==" in text]
    assert {one.name for one in optional} == LIBRARIES
