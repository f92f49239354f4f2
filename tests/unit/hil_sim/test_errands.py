"""What is asked of the thread of a bus is done there, or refused; no caller waits for a thread that has ended."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.support.waiting import PATIENCE_S
from trade_hil_sim import SimulationError
from trade_hil_sim.robot._bus_thread import Mailbox, ready

pytestmark = pytest.mark.virtual_time


def test_what_was_asked_is_done_in_the_thread_that_listens_and_answered() -> None:
    errands = Mailbox("bus leg", PATIENCE_S)
    errands.open()
    with ThreadPoolExecutor(1) as other:
        asking = other.submit(errands.ask, threading.get_ident)
        assert ready([errands.wake_read], timeout_s=PATIENCE_S)
        errands.run()
        assert asking.result(PATIENCE_S) == threading.get_ident()
        failing = other.submit(errands.ask, lambda: 1 // 0)
        assert ready([errands.wake_read], timeout_s=PATIENCE_S)
        errands.run()
        with pytest.raises(ZeroDivisionError):
            failing.result(PATIENCE_S)
    errands.close()


def test_closing_informs_waiting_clients_and_refuses_later_ones() -> None:
    errands = Mailbox("bus leg", PATIENCE_S)
    errands.open()
    done: list[str] = []
    with ThreadPoolExecutor(1) as other:
        asking = other.submit(errands.ask, lambda: done.append("late"))
        assert ready([errands.wake_read], timeout_s=PATIENCE_S)
        errands.close()
        with pytest.raises(SimulationError, match="bus leg is closed"):
            asking.result(PATIENCE_S)
    with pytest.raises(SimulationError, match="bus leg is closed"):
        errands.ask(lambda: done.append("later"))
    errands.ring()
    assert not done
