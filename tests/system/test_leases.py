"""Two gateways of one process that share a container: who has it, what it knows there, and what is refused."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.system.supervised import COUNTER, Keeping, call
from trade import Container
from trade.errors import AccessDenied, ConfigurationError
from trade_gateway.process._kill_timer import uptime_s
from trade_gateway.supervisor import ChildServices

STANDBY = '[container.a]\nstands_in_for = "rover"\nlease_s = 2.0\nsave_every_s = 1\n'
LEASED = '[container.a]\nlease_from = "base"\nsave_every_s = 1\nrestarts = 1\n'


class Pair:
    """``base`` is the standby for ``rover``; between them is what base offers, which can be withdrawn."""

    def __init__(self, folder: Path, start: Callable[..., Container]) -> None:
        self.base, self.rover = (Keeping(folder, start(name), 20.0) for name in ("base", "rover"))
        self._functions = ChildServices(self.base.supervisor)
        self._links = 0

    def link(self) -> None:
        self._links += 1  # a name is used once in one epoch
        self.base.member.register_functions(self._functions, f"supervisor{self._links}")

    def cut(self) -> None:
        self.base.member.deregister(self._functions)

    def knows(self) -> object:
        return self.base.supervisor._store.load("a")

    def handed_back(self) -> bool:
        with suppress(ConfigurationError):
            self.base.supervisor.standby_of("a").hand_back()
            return True
        return False


@pytest.fixture
def pair(system: str, tmp_path: Path, start_container: Callable[..., Container]) -> Iterator[Pair]:
    made = Pair(tmp_path, start_container)
    made.link()
    yield made
    made.rover.supervisor.close()
    made.base.supervisor.close()


def test_P71_containers_of_a_lost_gateway_move_to_the_standby_with_state_and_return_by_hand(
    pair: Pair,
) -> None:
    pair.base.set_children(STANDBY + COUNTER)
    pair.rover.set_children(LEASED + COUNTER)
    pair.rover.become("a", "up")
    wait_until(lambda: pair.base.become("a", "elsewhere").why == "rover has it", "rover has asked")
    call("count")
    call("count")
    wait_until(lambda: pair.knows() == {"tiny:Counter hall": {"total": 2}}, "base knows it")
    pair.cut()
    pair.base.become("a", "up")
    lost = pair.rover.become("a", "elsewhere")
    assert (lost.pid, lost.why.startswith("no lease: ")) == (0, True)
    assert call("count") == 3
    with pytest.raises(ConfigurationError, match="rover has not requested it for 2 s"):
        pair.base.supervisor.standby_of("a").hand_back()
    pair.link()
    wait_until(pair.handed_back, "rover asks again")
    pair.rover.become("a", "up")
    assert pair.base.become("a", "elsewhere").pid == 0
    assert call("shown") == 3


def test_a_container_given_up_where_it_is_leased_is_tried_on_the_standby(pair: Pair) -> None:
    pair.base.set_children(STANDBY + COUNTER)
    pair.rover.set_children(LEASED + 'providers = [{ class = "tiny:Dies", groups = ["hall"] }]\n')
    pair.rover.become("a", "given up")
    pair.base.become("a", "up")
    assert pair.rover.supervisor.restart("a", "anna")
    refused = "no lease: the standby has it"
    wait_until(lambda: pair.rover.become("a", "elsewhere").why == refused, "rover asks again, and is refused")


@pytest.mark.parametrize(("class_", "state"), [("Wheel", "given up"), ("Loose", "up")])
def test_S20_what_drives_something_of_its_host_is_leased_only_if_its_class_is_relocatable(
    pair: Pair, class_: str, state: str
) -> None:
    pair.base.set_children(STANDBY + COUNTER)
    pair.rover.set_children(LEASED + f'providers = [{{ class = "tiny:{class_}", groups = ["hall"] }}]\n')
    found = pair.rover.become("a", state)
    assert ("it drives wheel of this host" in found.why) == (state == "given up")


def test_late_saves_and_other_gateways_change_nothing(pair: Pair) -> None:
    pair.base.set_children(STANDBY + COUNTER)
    pair.base.become("a", "elsewhere")
    there = pair.base.supervisor.standby_of("a")
    wait_until(lambda: there.lease(None, "rover", "").turn, "what it had before is known to have ended")
    first = there.lease(None, "rover", "").turn
    turn = there.lease(None, "rover", "").turn
    assert there.lease(None, "rover", turn).turn == turn
    one, two = b"\x81\xa1x\x01", b"\x81\xa1x\x02"
    assert there.keep_for(None, "rover", turn, 2, two)
    assert not there.keep_for(None, "rover", turn, 1, one)  # overtaken
    assert not there.keep_for(None, "rover", turn, 2, one)
    assert not there.keep_for(None, "rover", first, 9, one)  # of a turn before
    assert not there.keep_for(None, "rover", "", 9, one)
    for data in (b"no states", bytes(17 * 1024 * 1024)):
        with pytest.raises(ConfigurationError, match="states of a"):
            there.keep_for(None, "rover", turn, 3, data)
    assert pair.knows() == {"x": 2}
    for caller, gateway in ((None, "mallory"), ("mallory", "rover")):
        with pytest.raises(AccessDenied, match="only rover"):
            there.lease(caller, gateway, turn)
        with pytest.raises(AccessDenied, match="only rover"):
            there.keep_for(caller, gateway, turn, 9, one)
    with pytest.raises(ConfigurationError, match="no standby for a container 'b'"):
        pair.base.supervisor.standby_of("b")


def test_a_container_moves_with_its_state_from_a_busy_host_to_the_least_loaded_one(
    pair: Pair, tmp_path: Path, start_container: Callable[..., Container]
) -> None:
    standby = STANDBY.replace('"rover"', '["rover", "cart"]')
    cart = Keeping(tmp_path, start_container("cart"), 20.0)
    try:
        pair.base.set_children(f"{standby}move_above = 1.0\n{COUNTER}")
        pair.rover.set_children(LEASED + COUNTER)
        first = pair.rover.become("a", "up")
        cart.set_children(LEASED + COUNTER)
        call("count")
        there = pair.base.supervisor.standby_of("a")
        wait_until(lambda: there._loads._loads.keys() == {"", "rover", "cart"}, "base knows the loads of all hosts")
        pair.base.set_children(standby + COUNTER)  # from now on, the test says what the loads are
        wait_until(lambda: "cart" in there._arbiter.asked_at, "cart asks for it")
        for s in (6.0, 4.0, 2.0, 0.0):
            now = uptime_s() - s
            for host, load in (("", 0.5), ("rover", 0.9), ("cart", 0.1)):
                there._loads.note(host, load, now)
            there._balance(now, above=0.8)
        cart.become("a", "up")
        assert call("shown") == 1  # saved on its way, not by the interval
        left = pair.rover.become("a", "elsewhere")
        assert left.pid == 0
        assert first.pid != (cart.child("a") or first).pid
    finally:
        cart.supervisor.close()
