"""A robot file to begin with, out of what a scan found."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from trade.errors import ConfigurationError
from trade_drivers import Found, parse

__all__ = ["first_file"]

_HEAD: Final = """\
# Written by `trade scan`. Give the robot, its buses and its devices names of your own, as in [joint."neck.pan"].
# `trade calibrate FILE JOINT` measures zero and range of a joint and writes them here; docs/commissioning.md.

[robot]
name = "robot"
"""
_BUS: Final = """
[bus.{bus}]
driver = "{driver}"
port = {port}
baud = {baud}
"""
_JOINT: Final = """
[joint.{name}]
bus = "{bus}"
id = {id}
model = "{model}"
firmware = "{firmware}"      # another one is refused when the robot comes up: is it another device?
offset_rad = 0.0
min_rad = -0.1           # `trade calibrate` measures both
max_rad = 0.1
max_speed_rad_s = 1.0
max_accel_rad_s2 = 10.0
"""
_GRIPPER: Final = """
[gripper.{name}]
bus = "{bus}"
id = {id}
model = "{model}"
max_width_m = 0.085
max_speed_m_s = 0.05
max_force_n = 40.0
"""


def first_file(found: Sequence[tuple[str, Found]], path: Path) -> str:
    """The text of a robot file with these devices, each with the port it was found on.

    Raises:
        ConfigurationError: a device has a problem, or those of one port speak at different rates.
    """
    for port, one in found:
        if one.problem:
            raise ConfigurationError(where=f"{port}, id {one.id}", problem=f"{one.problem}. No robot file was written")
    text = _HEAD
    for number, port in enumerate(dict.fromkeys(port for port, _ in found), 1):
        here = [one for at, one in found if at == port]
        rates = sorted({one.baud for one in here})
        if len(rates) > 1:
            problem = (
                f"its devices speak at {' and '.join(map(str, rates))} baud; have all speak at one (`trade set-baud`)"
            )
            raise ConfigurationError(where=port, problem=f"{problem}. No robot file was written")
        bus = f"line{number}"
        quoted = msgspec.json.encode(str(Path(port).absolute())).decode()
        text += _BUS.format(bus=bus, driver=here[0].driver, port=quoted, baud=rates[0])
        for one in here:
            stub = _GRIPPER if one.kind == "gripper" else _JOINT
            name = f"{one.kind}{number}_{one.id}"
            text += stub.format(name=name, bus=bus, id=one.id, model=one.model, firmware=one.firmware)
    parse(text, str(path))
    return text
