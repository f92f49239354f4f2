"""Moments that others tell, in words."""

import math
import time

import pytest

from trade._notifications.triggers import TriggerSpec
from trade.errors import ConfigurationError, LockedByOther
from trade.timestamps import clock, day_and_clock

pytestmark = pytest.mark.virtual_time

NO_MOMENTS = [1e300, -1e300, math.inf, -math.inf, math.nan]


@pytest.fixture(autouse=True)
def _in_greenwich(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "localtime", time.gmtime)


def test_a_moment_is_shown_as_clock_time() -> None:
    assert clock(86_399.9996) == "23:59:59"
    assert clock(86_399.9996, ms=True) == "23:59:59.999"
    assert clock(3.25, ms=True) == "00:00:03.250"
    assert day_and_clock(86_400) == "1970-01-02 00:00:00"


@pytest.mark.parametrize("at", NO_MOMENTS)
def test_a_value_that_is_no_moment_is_shown_nevertheless(at: float) -> None:
    assert clock(at) == clock(at, ms=True) == day_and_clock(at) == "?"


@pytest.mark.parametrize("at", NO_MOMENTS)
def test_an_error_with_a_moment_that_is_none_says_what_it_is(at: float) -> None:
    error = LockedByOther(resources=["rosie.neck"], owner="planner/walk", since=at)
    assert "rosie.neck is locked by planner/walk since ?" in str(error)


@pytest.mark.parametrize("at", [*NO_MOMENTS, -1.0])
def test_nothing_is_done_at_a_moment_that_is_none(at: float) -> None:
    with pytest.raises(ConfigurationError, match="not a valid time"):
        TriggerSpec(occasion="at", at=at).check()
