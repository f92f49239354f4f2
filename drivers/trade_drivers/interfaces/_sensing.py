"""The vendor-neutral interfaces of cameras and sensors. They only observe; they move nothing."""

from abc import ABC, abstractmethod
from typing import Final, Literal

from msgspec import Struct

from trade import service

ImageFormat = Literal["jpeg", "png", "rgb8", "mono8"]
"""A complete file, or raw pixels row by row from the upper left, of three bytes (red, green, blue) or one."""

UNITS: Final = frozenset(
    {
        *("1", "m", "m/s", "m/s2", "rad", "rad/s", "s", "Hz"),
        *("kg", "N", "N*m", "Pa", "K", "degC"),
        *("A", "V", "W", "J", "C", "T", "lx", "kg/m3"),
    }
)
"""Units of readings: SI, with angles in rad, degC for degrees Celsius and 1 for fractions and counts."""


class Image(Struct, frozen=True, kw_only=True):
    """One picture of a camera."""

    name: str
    """The camera, such as ``rosie.eye``."""
    data: bytes
    """The picture, in its format."""
    format: ImageFormat
    width_px: int
    height_px: int
    stamp_ns: int
    """Time of capture: ``time.monotonic_ns()`` of the driver's process. If the camera does not report it, the time of
    the request."""
    age_s: float
    """Age of the value."""


class CameraInfo(Struct, frozen=True, kw_only=True):
    """The properties of a camera's images."""

    name: str
    model: str
    """As the device reports it; empty if it does not."""
    format: ImageFormat
    width_px: int
    height_px: int


class Reading(Struct, frozen=True, kw_only=True):
    """One measurement of a sensor."""

    name: str
    """The sensor, such as ``rosie.oven.temperature``."""
    value: float | list[float]
    """One number, or a vector of the size in info()."""
    unit: str
    """Unit of each number; one of ``UNITS``."""
    stamp_ns: int
    """Time of measurement: ``time.monotonic_ns()`` of the driver's process. If the sensor does not report it, the time
    of the request."""
    age_s: float
    """Age of the value."""
    quality: Literal["good", "doubtful"] = "good"
    """``doubtful``: the device itself does not trust the value, as it is warming up or outside its range."""


class SensorInfo(Struct, frozen=True, kw_only=True):
    """The properties of a sensor's readings."""

    name: str
    model: str
    """As the device reports it; empty if it does not."""
    unit: str
    """One of ``UNITS``."""
    size: int
    """0: a value is one number; otherwise the length of the vector."""
    low: float
    """Lower end of the range, in the sensor's unit."""
    high: float
    """Upper end of the range."""
    rate_hz: float
    """Measurements per second."""


class Camera(ABC):
    """A camera. Requesting an image moves and sets nothing; any number of clients may do so at the same time."""

    @service(effect="read")
    @abstractmethod
    def image(self) -> Image:
        """Returns an image, captured for this call or recent enough for the driver to trust.

        Raises:
            DeviceSilent: the camera does not answer, or its newest image is too old.
            DeviceFault: the camera answers with an error, or with something other than an image.
        """

    @service(effect="read")
    @abstractmethod
    def info(self) -> CameraInfo:
        """Returns the format and size of all images."""

    @abstractmethod
    def close(self) -> None:
        """Closes the device; not a service. May be called repeatedly."""


class Sensor(ABC):
    """A sensor. Reading it moves and sets nothing; any number of clients may do so at the same time."""

    @service(effect="read")
    @abstractmethod
    def read(self) -> Reading:
        """Returns the newest measurement.

        Raises:
            DeviceSilent: the newest measurement is too old.
        """

    @service(effect="read")
    @abstractmethod
    def info(self) -> SensorInfo:
        """Returns the unit, vector length, range and rate."""

    @abstractmethod
    def close(self) -> None:
        """Closes the device; not a service. May be called repeatedly."""
