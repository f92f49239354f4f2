"""A template of a robot file, made from the devices that a scan found."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from trade.errors import ConfigurationError
from trade_drivers import ScannedDevice, parse

UNMEASURED_RAD: Final = 0.1
"""The placeholder range of a joint that was not measured, to both sides of zero."""

_HEAD: Final = """\
# Written by `trade scan`. Name the robot, its buses and its devices, as in [joint."neck.pan"].
# `trade calibrate FILE JOINT` measures zero and range of a joint and writes them here; docs/commissioning.md.

[robot]
name = "robot"
"""


def first_file(found: Sequence[tuple[str, ScannedDevice]], path: Path) -> str:
    """Returns the text of a robot file with these devices, each with its port.

    Raises:
        ConfigurationError: a device has a problem, or the devices of one port have different rates or drivers.
    """
    for port, one in found:
        if one.problem:
            raise ConfigurationError(where=f"{port}, id {one.id}", problem=f"{one.problem}. No robot file was written")
    text = _HEAD
    for number, port in enumerate(dict.fromkeys(port for port, _ in found), 1):
        here = [one for at, one in found if at == port]
        rates = sorted({one.baud for one in here})
        if len(rates) > 1:
            several = " and ".join(map(str, rates))
            problem = f"its devices use {several} baud; set all to one rate with `trade set-baud`"
            raise ConfigurationError(where=port, problem=f"{problem}. No robot file was written")
        names = sorted({one.driver for one in here})
        if len(names) > 1:
            problem = f"its devices have the drivers {' and '.join(names)}; a bus has one driver, so scan with --driver"
            raise ConfigurationError(where=port, problem=f"{problem}. No robot file was written")
        text += _table(f"bus.line{number}", _bus(port, here[0]))
        for one in here:
            keys = {"joint": _joint, "gripper": _gripper, "arm": _arm}[one.kind](one)
            text += _table(f"{one.kind}.{one.kind}{number}_{one.id}", [f'bus = "line{number}"', *keys])
    parse(text, str(path))
    return text


def _table(name: str, keys: Iterable[str]) -> str:
    return "\n".join(["", f"[{name}]", *keys, ""])


def _bus(port: str, one: ScannedDevice) -> list[str]:
    if one.kind == "arm":
        return [f"driver = {_text(one.driver)}", f"host = {_text(port)}    # set it to remote control"]
    if one.wire == "can":
        interface, _, channel = port.partition(":")
        keys = [f"interface = {_text(interface)}", f"channel = {_text(channel)}", f"bitrate = {one.baud}"]
    else:
        keys = [f"port = {_text(str(Path(port).absolute()))}", f"baud = {one.baud}"]
    if one.driver == "odrive":
        keys.append('leave = "relax"    # without its driver an ODrive releases the motor: add a brake')
    return [f"driver = {_text(one.driver)}", *keys]


def _joint(one: ScannedDevice) -> list[str]:
    keys = [f"id = {one.id}", f"model = {_text(one.model)}"]
    if one.firmware:
        keys.append(f"firmware = {_text(one.firmware)}      # any other is refused as another device")
    if one.serial_number is not None:
        keys.append(f"serial_number = {one.serial_number}    # any other is refused as another device")
    if one.homing_counts:
        keys.append(f"homing_counts = {one.homing_counts}    # its own homing offset; any other is refused")
    if one.wire == "can":
        if one.driver == "cia402":
            keys.append(_counts_per_rev(one.counts_per_rev))
        keys.append("gear = 1.0              # motor turns per joint turn")
        keys.append('# zero = "last"         # or "kept": how its zero is known after a loss of power')
        measures = "to be measured"
    else:
        measures = "`trade calibrate` measures both"
    return [
        *keys,
        "offset_rad = 0.0",
        f"min_rad = {-UNMEASURED_RAD}          # {measures}",
        f"max_rad = {UNMEASURED_RAD}",
        "max_speed_rad_s = 1.0",
        "max_accel_rad_s2 = 10.0",
    ]


def _counts_per_rev(reported: float | None) -> str:
    if reported is None:
        return "counts_per_rev = 4096   # encoder counts per motor turn: see the data sheet"
    return f"counts_per_rev = {reported:.12g}   # per motor turn, as the drive says"


def _gripper(one: ScannedDevice) -> list[str]:
    return [
        f"id = {one.id}",
        f"model = {_text(one.model)}",
        "max_width_m = 0.085",
        "max_speed_m_s = 0.05",
        "max_force_n = 40.0",
    ]


def _arm(one: ScannedDevice) -> list[str]:
    return [
        f"model = {_text(one.model)}",
        "min_rad = [-3.1, -3.1, -2.8, -3.1, -3.1, -3.1]    # from the base to the tool",
        "max_rad = [3.1, 3.1, 2.8, 3.1, 3.1, 3.1]",
        "max_speed_rad_s = 0.5",
        "max_accel_rad_s2 = 1.5",
        "max_speed_m_s = 0.25",
        "max_accel_m_s2 = 0.8",
    ]


def _text(value: str) -> str:
    return msgspec.json.encode(value).decode()
