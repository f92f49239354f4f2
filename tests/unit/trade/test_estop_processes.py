"""S09 on real processes: frozen ones are missing, stop when they wake, and keep no caller waiting."""

import threading
import time
from collections.abc import Callable
from typing import Any

import psutil
import pytest

from trade import Container, Estop, where
from trade._estop.ledger import MOST_OF_ONE
from trade.errors import Stopped, TradeError
from trade.protocol.keys import estop_key
from trade.protocol.messages import PROTOCOL, EstopOrder, encode_message

pytestmark = pytest.mark.realtime

Eventually = Callable[[Callable[[], bool]], bool]
PATIENCE_S = 30.0

DRIVER = """
    import ctypes, psutil, threading
    class Axis:
        def __init__(self):
            self.joint = trade.Resource(sys.argv[1] + ".joint")
            self.resources = [self.joint]
            self.stops = 0
        @service
        def move_to(self, goal: float) -> float:
            return goal
        @service(effect="read")
        def stopped(self) -> int:
            return self.stops
        @service(effect="read")
        def swallow(self, data: bytes) -> None: ...
        @service(effect="read")
        def resident(self) -> int:
            getattr(ctypes.CDLL(None), "malloc_trim", int)(0)  # what glibc keeps of it is no cost
            return psutil.Process().memory_info().rss
        @service(effect="stop")
        def stop(self) -> None:
            self.stops += 1
    with Container(Settings.read(container=sys.argv[1])) as container:
        container.register(Axis(), sys.argv[1])
        say("up")
        hear()
"""


@pytest.fixture
def driver(start_program: Callable[..., Any]) -> Callable[[str], Any]:
    def start(name: str) -> Any:
        program = start_program(DRIVER, name)
        assert program.heard() == "up"
        return program

    return start


def refused(container: Container, group: str) -> bool:
    """Whether its joint is held by an e-stop."""
    try:
        container.find(where(name="move_to", group=group), wait_s=PATIENCE_S)(0.1)
    except Stopped as stopped:
        return stopped.estop
    except TradeError:  # not linked again yet
        return False
    return False


def test_S09_a_frozen_driver_is_missing_and_stops_when_it_wakes(
    here: Container, driver: Callable[[str], Any], eventually: Eventually
) -> None:
    frozen, _ = driver("frozen"), driver("well")
    for group in ("frozen", "well"):
        here.find(where(name="stopped", group=group), wait_s=PATIENCE_S)
    frozen.freeze()
    limit_s = 1.0
    begun = time.monotonic()
    report = here.estop("smoke", limit_s=limit_s)
    waited_s = time.monotonic() - begun
    frozen.thaw()
    assert [name.rpartition("/")[2] for name in report.confirmed] == ["well"]
    assert [name.rpartition("/")[2] for name in report.missing] == ["frozen"]
    assert waited_s < 2 * limit_s
    assert refused(here, "well")
    assert eventually(lambda: refused(here, "frozen"))
    stopped = here.find(where(name="stopped", group="frozen"), wait_s=PATIENCE_S)
    assert stopped() == 1


def test_S09_a_driver_frozen_beyond_its_lease_latches_when_it_is_back(
    here: Container, driver: Callable[[str], Any], eventually: Eventually
) -> None:
    frozen = driver("frozen")
    stopped = here.find(where(name="stopped"), wait_s=PATIENCE_S)
    frozen.freeze()
    assert eventually(lambda: not here.services(where(name="stopped")))
    assert not here.estop(limit_s=0.2).complete
    frozen.thaw()
    assert eventually(lambda: refused(here, "frozen"))
    assert stopped() == 1


def test_S09_a_link_that_is_full_keeps_the_caller_no_longer_than_its_limit(
    here: Container, driver: Callable[[str], Any]
) -> None:
    frozen, _ = driver("frozen"), driver("well")
    swallow = here.find(where(name="swallow", group="frozen"), wait_s=PATIENCE_S)
    here.find(where(name="stopped", group="well"), wait_s=PATIENCE_S)
    swallow(b"")
    frozen.freeze()

    def fill() -> None:
        with pytest.raises(TradeError):
            swallow.with_(deadline_s=PATIENCE_S)(bytes(40 << 20))

    filling = threading.Thread(target=fill)
    filling.start()
    limit_s = 1.0
    begun = time.monotonic()
    report = here.estop(limit_s=limit_s)
    waited_s = time.monotonic() - begun
    frozen.kill()
    filling.join(PATIENCE_S)
    assert waited_s < 2 * limit_s
    assert [name.rpartition("/")[2] for name in report.confirmed] == ["well"]
    assert [name.rpartition("/")[2] for name in report.missing] == ["frozen"]


def test_S09_a_killed_driver_stays_latched_after_restart_without_other_containers(
    start_container: Callable[..., Container], driver: Callable[[str], Any]
) -> None:
    first = driver("arm")
    caller = start_container("caller")
    caller.find(where(name="stopped"), wait_s=PATIENCE_S)
    report = caller.estop("spill", limit_s=PATIENCE_S)
    assert report.complete
    caller.close()
    first.kill()
    driver("arm")
    other = start_container("other")
    with pytest.raises(Stopped, match="spill"):
        other.find(where(name="move_to"), wait_s=PATIENCE_S)(0.1)
    assert other.estop_clear([estop.id for estop in other.estops()], limit_s=PATIENCE_S).complete
    assert other.find(where(name="move_to"), wait_s=PATIENCE_S)(0.1) == 0.1


def test_S09_a_killed_driver_that_missed_the_clearing_is_latched_after_its_restart(
    here: Container, driver: Callable[[str], Any]
) -> None:
    first, _ = driver("arm"), driver("base")
    for group in ("arm", "base"):
        here.find(where(name="stopped", group=group), wait_s=PATIENCE_S)
    report = here.estop("spill", limit_s=PATIENCE_S)
    first.kill()
    here.estop_clear([report.id], limit_s=PATIENCE_S)
    assert here.find(where(name="move_to", group="base"), wait_s=PATIENCE_S)(0.1) == 0.1
    driver("arm")
    with pytest.raises(Stopped, match="spill"):
        here.find(where(name="move_to", group="arm"), wait_s=PATIENCE_S)(0.1)


def test_S09_thousands_of_e_stops_of_one_identity_cost_a_driver_neither_threads_nor_memory(
    here: Container, driver: Callable[[str], Any], eventually: Eventually
) -> None:
    program = driver("arm")
    stopped = here.find(where(name="stopped"), wait_s=PATIENCE_S)
    resident = here.find(where(name="resident"), wait_s=PATIENCE_S)
    process = psutil.Process(program.process.pid)
    threads, before = process.num_threads(), resident()
    orders = here._parts.transport.publish(estop_key(here.address.identity), urgent=True)
    most = 0
    for count in range(3000):
        name = f"flood{count}"
        orders.put(encode_message(EstopOrder(PROTOCOL, name, Estop(name, str(here.address), "", time.time()))))
        if count % 300 == 0:
            most = max(most, process.num_threads())
    report = here.estop("the last one", limit_s=PATIENCE_S)
    assert report.complete
    assert max(most, process.num_threads()) < threads + 20
    assert eventually(lambda: resident() < before + (20 << 20))  # once all are handled
    assert stopped() > 0
    there = here.find(where(name="estops", group="trade", container="arm"), wait_s=PATIENCE_S)
    assert len(there()) < 2 * MOST_OF_ONE  # what others have open is in it

    def all_cleared() -> bool:
        ids = [one.id for one in here.estops()]
        return not ids or (here.estop_clear(ids).complete and not here.estops())

    assert eventually(all_cleared)
    assert here.find(where(name="move_to"), wait_s=PATIENCE_S)(0.1) == 0.1
