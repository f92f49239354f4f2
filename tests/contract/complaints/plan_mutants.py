"""What naive code makes of plans, of recordings and of files. Each changes one function or one constant."""

from collections.abc import Hashable

import pytest

from trade_drivers.interfaces import _trajectory
from trade_drivers.motion._ramps import RampSegment
from trade_gateway.recording._timeline import Timeline


def every_piece_is_cubic(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(RampSegment, "ramped", lambda *_: None)


def a_piece_takes_the_acceleration_that_it_needs(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(_trajectory, "_keep", lambda *_: None)
    ramped = RampSegment.ramped
    patch.setattr(RampSegment, "ramped", lambda self, speed, accel: ramped(self, speed, 2 * accel))


def rest_is_exactly_0(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(_trajectory, "_REST_RAD_S", 0.0)


def every_last_speed_is_rest(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(_trajectory, "_REST_RAD_S", 1.0)


def the_first_time_is_exactly_0(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(_trajectory, "_AT_ONCE_S", 1e-300)


def samples_have_the_time_of_the_wall_clock(patch: pytest.MonkeyPatch) -> None:
    def placed(_self: Timeline, _source: Hashable, wall_s: float, _running_ns: int) -> float:
        return wall_s

    patch.setattr(Timeline, "placed", placed)


def a_byte_order_mark_is_text(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade.text_files.as_text", lambda data: data.decode())


def lines_end_as_on_unix(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_gateway.config.document.as_before", lambda _, text: text.encode())
