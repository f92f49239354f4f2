"""Checks of a robot file for joints of all vendors."""

from collections.abc import Callable, Iterable
from typing import Final

from trade.errors import ConfigurationError
from trade_drivers.joints._axis import Axis, AxisT
from trade_robotfile import Bus

_BRAKING_S: Final = 1.5


class DeviceUnusable(Exception):
    """A joint's device cannot be used as it is; has the reason and the key of the joint."""

    def __init__(self, problem: str, key: str = "") -> None:
        super().__init__(problem)
        self.key = key


def check_joints(axes: Iterable[AxisT], where: str, check: Callable[[AxisT], None]) -> None:
    """Checks each joint, and whether it brakes in time.

    Raises:
        ConfigurationError: a check failed; names the key and the right value.
    """
    for axis in axes:
        try:
            check(axis)
            _check_braking(axis)
        except DeviceUnusable as bad:
            raise ConfigurationError(where=f'{where}: joint."{axis.joint.name}"{bad.key}', problem=str(bad)) from None


def _check_braking(axis: Axis) -> None:
    braking_s = axis.joint.max_speed_rad_s / axis.joint.max_accel_rad_s2
    if braking_s > _BRAKING_S:
        problem = f"a stop from max_speed_rad_s takes {braking_s:.2g} s with it; it must take {_BRAKING_S} s at most"
        raise DeviceUnusable(problem, ".max_accel_rad_s2")


def check_least(axis: Axis, least: str) -> None:
    """Raises ``DeviceUnusable`` for limits below the device's resolution; ``least`` describes it."""
    for key, value, count in (
        (".max_speed_rad_s", axis.joint.max_speed_rad_s, axis.resolution.rad_s),
        (".max_accel_rad_s2", axis.joint.max_accel_rad_s2, axis.resolution.rad_s2),
    ):
        if value < count:
            raise DeviceUnusable(f"{value:.3g} is below {count:.3g}, {least}", key)


def check_rate(bus: Bus, where: str, times: int) -> None:
    """Raises ``ConfigurationError`` for a rate with too few cycles before a watchdog expires."""
    least_hz = times / min(bus.watchdog_s, bus.stale_after_s)
    if bus.rate_hz < least_hz:
        problem = f"{bus.rate_hz:g} is too slow for watchdog_s and stale_after_s; at least {least_hz:.3g}"
        raise ConfigurationError(where=f"{where}: bus.{bus.name}.rate_hz", problem=problem)
