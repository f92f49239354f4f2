"""A camera and a sensor in memory for tests: their images and readings are those that a test sets."""

import itertools
import time
from collections.abc import Sequence
from typing import Final

from trade.errors import InvalidArgument
from trade_drivers._validation import finite
from trade_drivers.interfaces._sensing import UNITS, Camera, CameraInfo, Image, Reading, Sensor, SensorInfo
from trade_drivers.testing._fake_device import FakeDevice

_STEP: Final = 8
"""The brightness between two pixels side by side."""
_BYTES_PER_PIXEL: Final = 3
_RATE_HZ: Final = 100.0


class FakeCamera(FakeDevice, Camera):
    """A camera whose images are the same in each run: a grey ramp, which each image shifts by one pixel.

    Its format is ``rgb8``. A fault raises ``DeviceFault``, as commands of other devices do.
    """

    def __init__(self, name: str, *, width_px: int = 32, height_px: int = 24) -> None:
        """A camera that shows the ramp.

        Args:
            name: its full name, such as ``rosie.eye``.
            width_px: of all images.
            height_px: of all images.
        """
        super().__init__(name)
        self._info = CameraInfo(name=name, model="fake", format="rgb8", width_px=width_px, height_px=height_px)
        self._scene: bytes | None = None
        self._shifts = itertools.count()

    def show(self, pixels: bytes) -> None:
        """Shows these pixels from the next image on: row by row from the upper left, 3 bytes each (red, green, blue).

        Raises:
            InvalidArgument: the number of bytes is not that of an image.
        """
        size = _BYTES_PER_PIXEL * self._info.width_px * self._info.height_px
        if len(pixels) != size:
            problem = f"has {len(pixels)} bytes; an image has {size}"
            raise InvalidArgument(service="show", argument="pixels", problem=problem)
        self._scene = pixels

    def image(self) -> Image:
        """Returns what the test shows, or the ramp."""
        self._answer()
        self._work()
        info, scene = self._info, self._scene
        return Image(
            name=info.name,
            data=self._ramp(next(self._shifts)) if scene is None else scene,
            format=info.format,
            width_px=info.width_px,
            height_px=info.height_px,
            stamp_ns=time.monotonic_ns(),
            age_s=0.0,
        )

    def info(self) -> CameraInfo:
        """Returns the format and size from the constructor."""
        return self._info

    def close(self) -> None:
        """Does nothing, as there is no device."""

    def _ramp(self, shift: int) -> bytes:
        row = b"".join(bytes([(column + shift) * _STEP % 256] * 3) for column in range(self._info.width_px))
        return row * self._info.height_px


class FakeSensor(FakeDevice, Sensor):
    """A sensor whose readings are those that a test sets. A fault raises ``DeviceFault``."""

    def __init__(
        self, name: str, value: float | Sequence[float], unit: str, *, low: float = -1000.0, high: float = 1000.0
    ) -> None:
        """A sensor with a first value.

        Args:
            name: its full name, such as ``rosie.oven.temperature``.
            value: one number, or a vector; all later values have its size.
            unit: one of ``UNITS``, such as ``degC``.
            low: lower end of the range, in the unit.
            high: upper end of the range.

        Raises:
            InvalidArgument: the unit is unknown, or the value is not finite.
        """
        super().__init__(name)
        if unit not in UNITS:
            problem = f"{unit!r} is not one of {', '.join(sorted(UNITS))}"
            raise InvalidArgument(service="FakeSensor", argument="unit", problem=problem)
        size = len(value) if isinstance(value, Sequence) else 0
        self._info = SensorInfo(name=name, model="fake", unit=unit, size=size, low=low, high=high, rate_hz=_RATE_HZ)
        self.set(value)

    def set(self, value: float | Sequence[float]) -> None:
        """Reads this value from now on; its quality is doubtful if it is outside the range.

        Raises:
            InvalidArgument: the value has another size, or is not finite.
        """
        values, is_vector = (value, True) if isinstance(value, Sequence) else ([value], False)
        size = len(values) if is_vector else 0
        if size != self._info.size or not values:
            problem = f"has size {size}; readings of {self._name} have size {self._info.size} (0: one number)"
            raise InvalidArgument(service="set", argument="value", problem=problem)
        numbers = [finite(number, "set", "value") for number in values]
        self._value = numbers if is_vector else numbers[0]

    def read(self) -> Reading:
        """Returns the value that the test set, measured now."""
        self._answer()
        self._work()
        value, info = self._value, self._info
        numbers = value if isinstance(value, list) else [value]
        return Reading(
            name=info.name,
            value=value,
            unit=info.unit,
            stamp_ns=time.monotonic_ns(),
            age_s=0.0,
            quality="good" if all(info.low <= number <= info.high for number in numbers) else "doubtful",
        )

    def info(self) -> SensorInfo:
        """Returns the unit, size and range from the constructor."""
        return self._info

    def close(self) -> None:
        """Does nothing, as there is no device."""
