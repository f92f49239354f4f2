"""A base class for sensors that a thread of their own polls; a driver implements the request."""

import logging
import threading
import time
from abc import abstractmethod
from typing import Final, Literal, NamedTuple, TypeVar

from trade.errors import BusGone, ConfigurationError, DeviceAbsent, DeviceSilent
from trade_drivers.interfaces._sensing import Reading, Sensor, SensorInfo

_log = logging.getLogger("trade")

_REOPEN_FIRST_S: Final = 0.1
_REOPEN_MOST_S: Final = 1.0
_END_S: Final = 5.0


class Measured(NamedTuple):
    """A measurement by the driver."""

    value: float | list[float]
    quality: Literal["good", "doubtful"] = "good"


_Polled = TypeVar("_Polled", bound="PolledSensor")


class PolledSensor(Sensor):
    """A sensor whose thread owns the port: services return the newest reading and never access the port.

    If ``open`` or ``measure`` raises any exception, the port is closed and reopened 0.1 to 1 s later.

    Args:
        info: the sensor's unit, range and rate.
        port: the port, for messages.
        stale_after_s: the age from which a measurement is an error.
    """

    def __init__(self, info: SensorInfo, port: str, *, stale_after_s: float = 1.0) -> None:
        self.port = port
        self._info = info
        self._stale_after_s = stale_after_s
        self._newest: tuple[Measured, int] | None = None
        self._gone = ""
        """Why the port is not open; empty if it is."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"sensor {info.name}", daemon=True)

    @abstractmethod
    def open(self) -> None:
        """Opens the port for exclusive use; raises OSError or ValueError if it cannot be opened."""

    @abstractmethod
    def measure(self) -> Measured:
        """Measures once within a second; raises OSError or ValueError for no answer or a wrong one."""

    @abstractmethod
    def hang_up(self) -> None:
        """Closes the port; may be called repeatedly, and before it was ever opened."""

    def start(self: _Polled, where: str) -> _Polled:
        """Measures once, then starts the polling thread.

        Raises:
            DeviceAbsent: the sensor does not answer, or has no port; the message names ``where``.
            ConfigurationError: the first measurement failed in another way.
        """
        try:
            self.open()
            self._take()
        except Exception as bad:
            self.hang_up()
            kind = DeviceAbsent if isinstance(bad, OSError) else ConfigurationError
            raise kind(where=where, problem=f"{self.port}: {_text(bad)}") from bad
        self._thread.start()
        return self

    def read(self) -> Reading:
        newest, now_ns = self._newest, time.monotonic_ns()
        if newest is None:
            raise DeviceSilent(device=self._info.name, bus=self.port, waited_s=self._stale_after_s)
        measured, stamp_ns = newest
        age_s = max(0, now_ns - stamp_ns) / 1e9
        if age_s > self._stale_after_s:
            if self._gone:
                raise BusGone(device=self._info.name, bus=self.port, waited_s=age_s, reason=self._gone)
            raise DeviceSilent(device=self._info.name, bus=self.port, waited_s=age_s)
        return Reading(
            name=self._info.name,
            value=measured.value,
            unit=self._info.unit,
            stamp_ns=stamp_ns,
            age_s=age_s,
            quality=measured.quality,
        )

    def info(self) -> SensorInfo:
        return self._info

    def close(self) -> None:
        self._ended.set()
        if self._thread.ident is not None:
            self._thread.join(_END_S)

    def _take(self) -> None:
        asked_ns = time.monotonic_ns()
        self._newest = (self.measure(), asked_ns)

    def _run(self) -> None:
        due, wait_s, is_open, is_well = time.monotonic(), _REOPEN_FIRST_S, True, True
        try:
            while not self._ended.wait(max(0.0, due - time.monotonic())):
                try:
                    if not is_open:
                        self.open()
                        is_open, self._gone = True, ""
                    self._take()
                    due, wait_s, is_well = max(due + 1 / self._info.rate_hz, time.monotonic()), _REOPEN_FIRST_S, True
                except Exception as bad:  # noqa: BLE001 - whatever a library raises: it is silent until it is back
                    if is_well:
                        _log.warning("%s on %s: %s; retrying", self._info.name, self.port, _text(bad))
                    self._gone = "" if is_open else _text(bad)
                    is_open = is_well = False
                    self.hang_up()
                    due, wait_s = time.monotonic() + wait_s, min(_REOPEN_MOST_S, 2 * wait_s)
        finally:
            self.hang_up()


def _text(bad: Exception) -> str:
    return str(bad) or type(bad).__name__
