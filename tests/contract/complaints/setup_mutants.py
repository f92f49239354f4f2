"""What naive code makes of setting up a robot and of its computer. Each changes one function."""

from collections.abc import Callable, Iterator, Sequence

import pytest

from trade.transport.addresses import Attempts
from trade.transport.endpoints import Endpoint
from trade_gateway.cli.hardware._calibrate import Sweep, TravelEnds
from trade_gateway.supervisor._restart_policy import ChildLife, Transition


def a_range_is_the_least_and_the_greatest_reading(patch: pytest.MonkeyPatch) -> None:
    def until(self: Sweep, done: Callable[[], bool], longest_s: float) -> TravelEnds:
        readings = [self.read()]
        while not done():
            readings.append(self.read())
        return TravelEnds(min(readings), max(readings), readings[-1])

    patch.setattr(Sweep, "until", until)


def a_start_without_its_device_is_a_crash(patch: pytest.MonkeyPatch) -> None:
    ended = ChildLife.ended

    def counted(self: ChildLife, now: float, how: str, *, absent: bool = False) -> Transition | None:
        return ended(self, now, how)

    patch.setattr(ChildLife, "ended", counted)


def no_rule_of_udev_is_read(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("trade_gateway.cli.hardware._doctor_brltty._lines", lambda _: [])


def addresses_are_tried_one_after_the_other(patch: pytest.MonkeyPatch) -> None:
    def accepting(self: Attempts, endpoints: Sequence[str]) -> Iterator[str]:
        for text in endpoints:
            for endpoint, problem in self._knock([Endpoint.read(text)], 4.0):
                if not problem:
                    yield str(endpoint)

    patch.setattr(Attempts, "accepting", accepting)
