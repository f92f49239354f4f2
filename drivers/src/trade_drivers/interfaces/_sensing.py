"""What a camera and a sensor can do, whoever built them. They look and measure; nothing of them moves."""

from abc import ABC, abstractmethod
from typing import Final, Literal

from msgspec import Struct

from trade import service

__all__ = ["UNITS", "Camera", "CameraInfo", "Image", "ImageFormat", "Reading", "Sensor", "SensorInfo"]

ImageFormat = Literal["jpeg", "png", "rgb8", "mono8"]
"""A whole file, or raw pixels row by row from the upper left, three bytes each (red, green, blue) or one."""

UNITS: Final = frozenset(
    {
        *("1", "m", "m/s", "m/s2", "rad", "rad/s", "s", "Hz"),
        *("kg", "N", "N*m", "Pa", "K", "degC"),
        *("A", "V", "W", "J", "C", "T", "lx", "kg/m3"),
    }
)
"""What readings are in: SI, with angles in rad, degC for the degree Celsius and 1 for fractions and counts."""


class Image(Struct, frozen=True, kw_only=True):
    """What a camera has seen."""

    name: str
    """The camera, such as ``rosie.eye``."""
    data: bytes
    """The picture, in its format."""
    format: ImageFormat
    width_px: int
    height_px: int
    stamp_ns: int
    """When it was captured: ``time.monotonic_ns()`` of the driver's process. If the camera does not tell, when it was
    asked."""
    age_s: float
    """How long ago that was."""


class CameraInfo(Struct, frozen=True, kw_only=True):
    """What a camera delivers."""

    name: str
    model: str
    """As the device says it; empty if it does not."""
    format: ImageFormat
    width_px: int
    height_px: int


class Reading(Struct, frozen=True, kw_only=True):
    """What a sensor has measured."""

    name: str
    """The sensor, such as ``rosie.oven.temperature``."""
    value: float | list[float]
    """One number, or a vector with as many as info() says."""
    unit: str
    """Of each number; one of ``UNITS``."""
    stamp_ns: int
    """When it was measured: ``time.monotonic_ns()`` of the driver's process. If the sensor does not tell, when it was
    asked."""
    age_s: float
    """How long ago that was."""
    quality: Literal["good", "doubtful"] = "good"
    """``doubtful``: the device itself does not vouch for it: it is warming up, or outside of what it can measure."""


class SensorInfo(Struct, frozen=True, kw_only=True):
    """What a sensor measures."""

    name: str
    model: str
    """As the device says it; empty if it does not."""
    unit: str
    """One of ``UNITS``."""
    size: int
    """0: a value is one number; else a vector of so many."""
    low: float
    """The least it can measure, in its unit."""
    high: float
    """The most."""
    rate_hz: float
    """So often it is measured."""


class Camera(ABC):
    """A camera. Asking for images moves nothing and sets nothing; any number of callers may at the same time."""

    @service(effect="read")
    @abstractmethod
    def image(self) -> Image:
        """What it sees: captured for this call, or so recently that its driver vouches for it.

        Raises:
            DeviceSilent: it does not answer, or its newest image is too old.
            DeviceFault: it answers with an error, or with what is no image.
        """

    @service(effect="read")
    @abstractmethod
    def info(self) -> CameraInfo:
        """What its images are like."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the device; no service. More than once is fine."""


class Sensor(ABC):
    """A sensor. Reading it moves nothing and sets nothing; any number of callers may at the same time."""

    @service(effect="read")
    @abstractmethod
    def read(self) -> Reading:
        """What was measured last.

        Raises:
            DeviceSilent: that was too long ago: an old value is no value.
        """

    @service(effect="read")
    @abstractmethod
    def info(self) -> SensorInfo:
        """What it measures."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the device; no service. More than once is fine."""
