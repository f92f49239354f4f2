"""The robot files of the demo: those of the examples, with the patience of a computer that simulates the devices, too.

A computer that has much else to do is late: its simulated devices answer late, and its drivers ask late. With the times
of the examples, this would look as if devices failed. So their buses run slower here, which halves the work, and
measurements and watchdogs last longer.
"""

import re
from collections.abc import Mapping
from typing import Final

PATIENCE: Final[Mapping[str, Mapping[str, float]]] = {
    "dynamixel": {"rate_hz": 40, "stale_after_s": 2, "watchdog_s": 2},
    "feetech": {"rate_hz": 25, "stale_after_s": 2, "watchdog_s": 2},
    "cia402": {"rate_hz": 25, "stale_after_s": 2, "watchdog_s": 1},  # a driver first listens for so long
    "odrive": {"rate_hz": 25, "stale_after_s": 2, "watchdog_s": 0.5},  # the longest there is
    "ur": {"rate_hz": 125, "stale_after_s": 2, "watchdog_s": 2},
    "robotiq": {"rate_hz": 10, "stale_after_s": 2},
}
"""The keys of a bus that are replaced or added, by its driver."""

_BUS: Final = re.compile(r"^\[bus\.\w+\]\n(?:(?!\[).*\n)*", re.MULTILINE)
_DRIVER: Final = re.compile(r'^driver = "(\w+)"', re.MULTILINE)


def patient(text: str) -> str:
    """Returns the text of a robot file with slower and more patient buses."""
    return _BUS.sub(lambda table: _changed(table[0]), text)


def _changed(table: str) -> str:
    [driver] = _DRIVER.findall(table)
    for key, value in PATIENCE[driver].items():
        table = re.sub(rf"^{key} = .*\n", "", table, flags=re.MULTILINE)
        table = table.replace("\n", f"\n{key} = {value}\n", 1)
    return table
