"""A host sets its wall clock back while a CAN bus is quiet: its driver does not wait for the clock to come again."""

import threading
import time
from contextlib import ExitStack

import pytest

from tests.unit.drivers.conftest import Outcome
from tests.unit.drivers.motor_rig import KINDS, ROOT
from trade.testing import virtual_time
from trade_drivers.bus.can import CanPort
from trade_hil_sim import CanBus

_BACK_S = -3600.0


@pytest.mark.parametrize("by_library", [True, False])
def test_S07_a_wait_for_a_frame_ends_in_its_time_after_the_clock_was_set_back(by_library: bool) -> None:
    """python-can's own receive waits for an hour: that is the control."""
    with virtual_time(packages=["tests"], limit_s=10_000) as clock, ExitStack() as undo:
        bus = undo.enter_context(CanBus(paced=False))
        port = CanPort(bus.port, 1_000_000)
        undo.callback(port.close)
        port.open()
        waiting = threading.Thread(target=lambda: port._open_bus().recv(0.05) if by_library else port.receive(0.05))
        began = time.monotonic()
        waiting.start()
        clock.sleep(0.01)
        clock.step_wall_clock(_BACK_S)
        waiting.join()
        assert (time.monotonic() - began > 3000) == by_library


@pytest.mark.parametrize("kind", list(KINDS))
def test_S07_a_stop_gets_through_after_the_clock_was_set_back(kind: str) -> None:
    with virtual_time(packages=["tests"]) as clock, ExitStack() as undo:
        rig = KINDS[kind](undo)
        rig.plug()
        motor = rig.attach().motor("tail.root")
        motor.enable()
        moving = Outcome(lambda: motor.move_to(0.9, 0.3))
        for _ in range(20):  # somewhere between a question and an answer, and where nothing is asked
            clock.sleep(0.0037)
            clock.step_wall_clock(_BACK_S)
        asked = time.monotonic()
        motor.stop()
        moving.wait()
        assert rig.truth(ROOT).position_rad < 0.3
        assert rig.events("at_rest", ROOT, asked)[0].t < asked + 0.5
