"""What the log has of a service that fails while it is listened to."""

import itertools
import logging

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from trade import errors, service, where
from trade.testing import memory_system

pytestmark = pytest.mark.virtual_time


class Sick:
    def __init__(self) -> None:
        self._silent_s = itertools.count(20)

    @service(effect="read")
    def state(self) -> float:
        raise errors.DeviceSilent(device="neck.pan", bus="/dev/ttyUSB0", waited_s=next(self._silent_s))


class Well:
    @service(effect="read")
    def state(self) -> float:
        return 0.5


@pytest.mark.parametrize("how", ["killed", "deregistered"])
def test_a_stream_that_passes_on_says_how_to_listen_to_what_comes_again(
    caplog: pytest.LogCaptureFixture, how: str
) -> None:
    heard: list[float] = []
    with caplog.at_level(logging.WARNING), memory_system() as system:
        robot, viewer, well = system.container("robot"), system.container("viewer"), Well()
        robot.register(well, "rosie.neck")
        viewer.stream(viewer.find(where(name="state"), wait_s=PATIENCE_S), hz=50, call=heard.append)
        wait_until(lambda: heard)
        if how == "killed":
            system.kill(robot)
            system.settle()
        else:
            robot.deregister(well)
        wait_until(lambda: any("trade.joined(" in one for one in caplog.messages))


def test_a_failure_that_only_lasts_longer_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), memory_system() as system:
        robot, viewer = system.container("robot"), system.container("viewer")
        robot.register(Sick(), "rosie.neck")
        with viewer.stream(where(name="state"), hz=50) as samples:
            texts = set()
            for _ in range(3):
                with pytest.raises(errors.DeviceSilent) as silent:
                    samples.next(PATIENCE_S)
                texts.add(str(silent.value))
    assert len(texts) == 3
    reported = [record for record in caplog.records if "while it is listened to" in record.getMessage()]
    assert len(reported) == 1
