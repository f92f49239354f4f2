"""The contract of Sensor, for drivers of all vendors."""

# ruff: noqa: S101 - these are tests

import math

from trade_drivers.interfaces._sensing import UNITS, Reading, Sensor, SensorInfo
from trade_drivers.testing._asking import at_once, streamed, until


class SensorContract:
    """Subclass it with a fixture ``sensor``: attached, with a value within its range. Nothing moves."""

    def test_a_reading_is_what_the_sensor_says_it_measures(self, sensor: Sensor) -> None:
        _check(sensor.read(), sensor.info())

    def test_its_unit_and_range_make_sense(self, sensor: Sensor) -> None:
        info = sensor.info()
        assert info.unit in UNITS
        assert info.low < info.high
        assert info.size >= 0
        assert 0 < info.rate_hz < math.inf

    def test_a_reading_has_its_time_of_measurement(self, sensor: Sensor) -> None:
        first = sensor.read()
        assert 0 <= first.age_s < 10
        until(lambda: sensor.read().stamp_ns > first.stamp_ns, "something later is measured")

    def test_many_callers_at_once_get_whole_readings(self, sensor: Sensor) -> None:
        for reading in at_once(sensor.read, 4):
            _check(reading, sensor.info())

    def test_readings_can_be_streamed(self, sensor: Sensor) -> None:
        first, second = streamed(sensor, sensor.info().name, "read")
        assert second.stamp_ns >= first.stamp_ns
        _check(second, sensor.info())


def _check(reading: Reading, info: SensorInfo) -> None:
    values = reading.value if isinstance(reading.value, list) else [reading.value]
    assert (reading.name, reading.unit) == (info.name, info.unit)
    assert len(values) == max(1, info.size)
    assert isinstance(reading.value, list) == (info.size > 0)
    assert all(math.isfinite(value) for value in values)
    if reading.quality == "good":
        assert all(info.low <= value <= info.high for value in values)
