"""What `trade up` tells of its joints, once for each change."""

import json
from typing import Any
from unittest.mock import create_autospec

import pytest

from trade.errors import DeviceSilent
from trade_drivers import Motor, MotorState
from trade_gateway._faults import FaultWatch
from trade_gateway._output import Output

SILENT = DeviceSilent(device="rosie.pan", bus="/dev/ttyUSB0", waited_s=0.3)
STATES: list[tuple[object, str | None]] = [
    ("", None),
    ("overload", "rosie.pan: overload. When you have looked: trade call rosie.pan.enable"),
    ("overload", None),
    (SILENT, str(SILENT)),
    (DeviceSilent(device="rosie.pan", bus="/dev/ttyUSB0", waited_s=0.8), None),
    (ZeroDivisionError("oops"), "rosie.pan: its state cannot be read: ZeroDivisionError('oops')"),
    ("is it blocked?", "rosie.pan: is it blocked? When you have looked: trade call rosie.pan.enable"),
    ("", ""),
    ("", None),
]


def state(fault: str) -> MotorState:
    numbers: dict[str, Any] = dict.fromkeys(
        ("position_rad", "velocity_rad_s", "load", "temperature_c", "voltage_v", "measured_at", "age_s"), 0.0
    )
    return MotorState(name="rosie.pan", enabled=True, moving=False, fault=fault, **numbers)


def test_each_change_is_told_once_in_both_directions(capsys: pytest.CaptureFixture[str]) -> None:
    motor = create_autospec(Motor, instance=True)
    motor.state.side_effect = [state(said) if isinstance(said, str) else said for said, _ in STATES]
    watch = FaultWatch({"rosie.pan": motor})
    for _, told in STATES:
        assert watch.tell(Output(as_json=True)) is (told is not None)
        lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert [(line["joint"], line["fault"]) for line in lines] == ([] if told is None else [("rosie.pan", told)])
