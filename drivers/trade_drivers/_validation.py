"""Checks that all drivers make before they send anything: arguments, and the installed library."""

from collections.abc import Sequence
from math import isfinite
from typing import Final

from trade.errors import ConfigurationError, InvalidArgument, LimitExceeded

LONGEST_VALID_S: Final = 1.0
"""The longest validity of a set-point."""


def finite(value: float, service: str, argument: str) -> float:
    """Returns a finite number, or raises InvalidArgument."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not isfinite(value):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise InvalidArgument(service=service, argument=argument, problem=f"{value!r} is not a finite number")
    return float(value)


def valid(valid_s: float, service: str) -> float:
    """Returns the validity of a set-point in seconds, or raises InvalidArgument."""
    if not 0 < finite(valid_s, service, "valid_s") <= LONGEST_VALID_S:
        problem = f"{valid_s!r} is not above 0 and at most {LONGEST_VALID_S:g}"
        raise InvalidArgument(service=service, argument="valid_s", problem=problem)
    return valid_s


def one_each(values: Sequence[float], joints: Sequence[str], service: str, argument: str) -> list[float]:
    """Returns one finite number for each joint, or raises InvalidArgument."""
    if len(values) != len(joints):
        problem = f"has {len(values)} values; it takes {len(joints)}, for {', '.join(joints)}"
        raise InvalidArgument(service=service, argument=argument, problem=problem)
    return [finite(value, service, argument) for value in values]


def within(value: float, lower: float, upper: float, what: str, unit: str) -> float:
    """Returns the value if it is in the range, or raises LimitExceeded."""
    if not lower <= value <= upper:
        raise LimitExceeded(what=what, value=value, lower=lower, upper=upper, unit=unit)
    return value


def not_installed(driver: str, library: str, missing: ImportError) -> ConfigurationError:
    """Returns the error for a driver whose library is missing, with its remedy."""
    problem = f'needs {library} ({missing}); pip install "trade-drivers[{driver}]"'
    return ConfigurationError(where=f"driver {driver}", problem=problem)
