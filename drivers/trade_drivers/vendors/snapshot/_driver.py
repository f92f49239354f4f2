"""The driver of network cameras with pictures over HTTP, and the camera itself."""

import socket
import time
from typing import Annotated, Final

from msgspec import Meta, Struct

import trade_robotfile
from trade import current_call
from trade.errors import ConfigurationError, DeviceAbsent, DeviceFault, DeviceSilent
from trade_drivers.interfaces._sensing import Camera, CameraInfo, Image, Sensor
from trade_drivers.plugins._driver import SenseDriver
from trade_drivers.vendors.snapshot._http import Place, ask, place_of
from trade_drivers.vendors.snapshot._picture import Picture, picture

_OK: Final = 200
_REMEDY: Final = "ask again, or look at the camera's own page"


class Options(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The options of such a camera in the robot file."""

    url: str
    """URL of the newest picture: ``http://192.168.0.20/snapshot.jpg``."""
    width_px: Annotated[int, Meta(ge=1)] | None = None
    """Required width of its pictures; any width by default."""
    height_px: Annotated[int, Meta(ge=1)] | None = None
    timeout_s: Annotated[float, Meta(gt=0, le=10)] = 1.0
    """Timeout of a picture."""


class SnapshotDriver(SenseDriver):
    """Network cameras that answer an HTTP request with a picture.

    In a robot file::

        [camera.eye]
        driver = "snapshot"
        url = "http://192.168.0.20/snapshot.jpg"
        width_px = 640
        height_px = 480
    """

    def check(self, device: trade_robotfile.Camera | trade_robotfile.Sensor) -> None:
        options = device.options_as(Options)
        try:
            place_of(options.url)
        except ValueError as bad:
            raise ConfigurationError(where=f"{device.where}: {device.key}.url", problem=str(bad)) from None

    def attach(
        self, name: str, device: trade_robotfile.Camera | trade_robotfile.Sensor, port: str | None
    ) -> Camera | Sensor:
        options = device.options_as(Options)
        where = f"{device.where}: {device.key}"
        try:
            url = port or options.url
            place = place_of(url)
            address = str(socket.getaddrinfo(place.host, place.port, type=socket.SOCK_STREAM)[0][4][0])
            shown, _ = _look(place._replace(host=address), name, url, options.timeout_s)
        except OSError as silent:
            raise DeviceAbsent(where=f"{where}.url", problem=str(silent)) from None
        except (ValueError, DeviceFault) as bad:
            raise ConfigurationError(where=f"{where}.url", problem=str(bad)) from None
        for key, wanted, is_ in (
            ("width_px", options.width_px, shown.width_px),
            ("height_px", options.height_px, shown.height_px),
        ):
            if wanted not in {None, is_}:
                raise ConfigurationError(where=f"{where}.{key}", problem=f"its pictures have {is_}, not {wanted}")
        return SnapshotCamera(name, url, place._replace(host=address), shown, options.timeout_s)


class SnapshotCamera(Camera):
    """One such camera. It keeps no connection between pictures."""

    def __init__(self, name: str, url: str, place: Place, shown: Picture, timeout_s: float) -> None:
        self._name, self._url, self._place, self._timeout_s = name, url, place, timeout_s
        self._shown = shown

    def image(self) -> Image:
        """Requests a picture. As the camera does not report the time of capture, its time is that of the request.

        Raises:
            DeviceSilent: no picture arrived in time.
            DeviceFault: an HTTP error, no picture, or one of another size than at attach.
        """
        asked_ns = time.monotonic_ns()
        shown, data = _look(self._place, self._name, self._url, self._patience_s())
        if shown != self._shown:
            fault = f"its pictures were {_text(self._shown)} when it was attached and are {_text(shown)} now"
            raise DeviceFault(device=self._name, bus=self._url, fault=fault, remedy="attach it again")
        return Image(
            name=self._name,
            data=data,
            format=shown.format,
            width_px=shown.width_px,
            height_px=shown.height_px,
            stamp_ns=asked_ns,
            age_s=(time.monotonic_ns() - asked_ns) / 1e9,
        )

    def info(self) -> CameraInfo:
        shown = self._shown
        return CameraInfo(
            name=self._name, model="", format=shown.format, width_px=shown.width_px, height_px=shown.height_px
        )

    def close(self) -> None:
        """Does nothing, as no connection is open."""

    def _patience_s(self) -> float:
        call = current_call()
        return self._timeout_s if call is None else max(0.001, call.patience_s(self._timeout_s))


def _look(place: Place, name: str, url: str, within_s: float) -> tuple[Picture, bytes]:
    began = time.monotonic()
    try:
        answer = ask(place, within_s)
        if answer.status != _OK:
            raise ValueError(f"HTTP {answer.status} {answer.reason}".rstrip())
        return picture(answer.body), answer.body
    except OSError:
        raise DeviceSilent(device=name, bus=url, waited_s=time.monotonic() - began) from None
    except ValueError as bad:
        raise DeviceFault(device=name, bus=url, fault=f"it answers with {bad}", remedy=_REMEDY) from None


def _text(shown: Picture) -> str:
    return f"{shown.format} of {shown.width_px} x {shown.height_px}"
