"""What `trade up` tells of its sensors: that one is silent, and that it is well again."""

import json
from unittest.mock import create_autospec

import pytest

from trade.errors import DeviceSilent
from trade_drivers import Camera, Reading, Sensor
from trade_gateway._faults import FaultWatch
from trade_gateway._output import Output

READING = Reading(name="rosie.scale", value=1.0, unit="kg", stamp_ns=0, age_s=0.0)
SILENT = DeviceSilent(device="rosie.scale", bus="/dev/ttyUSB0", waited_s=1.2)


def test_silence_and_its_end_are_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    sensor = create_autospec(Sensor, instance=True)
    watch, out = FaultWatch({"rosie.scale": sensor}), Output(as_json=True)
    sensor.read.side_effect = [READING, SILENT, SILENT, READING]
    assert [watch.tell(out) for _ in range(4)] == [False, True, False, True]
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(line["joint"], line["fault"]) for line in told] == [("rosie.scale", str(SILENT)), ("rosie.scale", "")]


def test_a_camera_is_not_asked_for_pictures_to_see_whether_it_is_well() -> None:
    camera = create_autospec(Camera, instance=True)
    assert not FaultWatch({"rosie.eye": camera}).tell(Output(as_json=True))
    camera.image.assert_not_called()
