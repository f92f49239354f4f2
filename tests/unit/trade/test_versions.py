"""Containers of two protocol versions in one system: neither sees what the other offers, and what stops all crosses."""

import logging
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from msgspec import msgpack

from trade import Container, service, where
from trade.errors import NoSuchService, Stopped
from trade.protocol.keys import (
    ALIVE,
    ESTOPS,
    Address,
    alive_key,
    estop_confirmed_key,
    estop_key,
    registry_key,
    tally_key,
)
from trade.protocol.messages import PROTOCOL, encode_message
from trade.testing import MemorySystem, memory_system
from trade.transport.base import ChannelClosed
from trade.transport.memory import MemoryTransport

pytestmark = pytest.mark.virtual_time

Eventually = Callable[[Callable[[], bool]], bool]
OTHER: Final = PROTOCOL + 1
GENEROUS_S: Final = 30.0


class Arm:
    def __init__(self) -> None:
        self.stopped = 0

    @service
    def move(self) -> str:
        return "moved"

    @service(effect="stop")
    def stop(self) -> None:
        self.stopped += 1


class Stranger:
    """What is seen of a container of another version: signs, entries, orders, confirmations. It is made of bytes.

    Args:
        memory: the system that it joins.
        obeys: whether it confirms orders to stop.
        open_: e-stops that are open in it.
    """

    def __init__(self, memory: MemorySystem, *, obeys: bool = True, open_: tuple[Any, ...] = ()) -> None:
        self.address = Address("tester", "stranger", "e1")
        self.asked = 0
        self.obeyed: list[str] = []
        self._obeys = obeys
        self._transport = MemoryTransport(memory.network, "stranger")
        self._orders = self._transport.publish(estop_key("tester"), urgent=True)
        self._confirmations = self._transport.publish(estop_confirmed_key(self.address), urgent=True)
        self._entries: dict[str, bytes] = {}
        self._questions = self._transport.questions(registry_key("*", self.address, "*"))
        self._heard = self._transport.subscribe(ESTOPS)
        self.tell(*open_)
        self._offer("arm", "Arm-1")
        self._threads = [
            threading.Thread(target=read, name="stranger", daemon=True) for read in (self._answer, self._listen)
        ]
        for thread in self._threads:
            thread.start()
        self._sign = self._transport.appear(alive_key(self.address))

    def _offer(self, domain: str, provider: str, **more: Any) -> None:
        """Announced in terms that this version does not have: services by name."""
        key = registry_key(domain, self.address, provider)
        self._entries[key] = encode_message({"v": OTHER, "services": {"move": 1}, **more})
        self._transport.announce(key, self._entries[key])

    def tell(self, *open_: Any) -> None:
        """These e-stops are open in it."""
        self._offer("trade", "estops", estops=open_)

    def order(self, *fields: Any) -> None:
        self._orders.put(encode_message((OTHER, *fields)))

    def _answer(self) -> None:
        while True:
            try:
                question = self._questions.receive()
                self.asked += 1
                for key, payload in list(self._entries.items()):
                    question.answer(key, payload)
                question.answer(tally_key(self.address), encode_message((OTHER, {"revision": 3})))
                question.close()
            except ChannelClosed:
                return

    def _listen(self) -> None:
        while True:
            try:
                self._hear()
            except ChannelClosed:
                return

    def _hear(self) -> None:
        heard = self._heard.receive()
        _, request, opened, *_ = [*msgpack.decode(heard.payload or b""), None]
        if heard.key.count("/") == 1 and isinstance(opened, list) and self._obeys:
            self.obeyed.append(opened[0])
            self._confirmations.put(encode_message((OTHER, request, "", "and more")))

    def close(self) -> None:
        self._transport.close()
        for thread in self._threads:
            thread.join(GENEROUS_S)


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[MemorySystem]:
    with memory_system(state_dir=tmp_path / "state") as made:
        yield made


Strangers = Callable[..., Stranger]


@pytest.fixture
def stranger(memory: MemorySystem) -> Iterator[Strangers]:
    made: list[Stranger] = []

    def join(**how: Any) -> Stranger:
        made.append(Stranger(memory, **how))
        memory.settle()
        return made[-1]

    yield join
    for each in made:
        each.close()


def arm_of(memory: MemorySystem, name: str = "one") -> Arm:
    made = Arm()
    memory.container(name).register(made, name)
    return made


def move(container: Container, group: str = "one") -> str:
    return container.call(where(name="move", group=group))


def test_a_container_of_another_version_is_shown_with_it_and_offers_nothing(
    memory: MemorySystem, stranger: Strangers, eventually: Eventually, caplog: pytest.LogCaptureFixture
) -> None:
    here = memory.container("here")
    with caplog.at_level(logging.WARNING, "trade"):
        other = stranger()
        assert eventually(lambda: any(info.protocol == OTHER for info in here.containers()))
        other.tell()
        memory.settle()
    shown = {info.name: (info.protocol, info.services) for info in here.containers()}
    assert shown["stranger"] == (OTHER, 0)
    assert shown["here"][0] == PROTOCOL
    with pytest.raises(NoSuchService):
        here.find(where(group="arm"), wait_s=0.0)
    said = [record.getMessage() for record in caplog.records if "stranger" in record.getMessage()]
    assert len(said) == 1
    assert f"speaks protocol version {OTHER}, this one speaks {PROTOCOL}" in said[0]


def test_the_version_of_a_silent_container_is_unknown(memory: MemorySystem, eventually: Eventually) -> None:
    here = memory.container("here")
    silent = Address("tester", "silent", "e1")
    transport = MemoryTransport(memory.network, "silent")
    transport.appear(alive_key(silent))
    assert eventually(lambda: any(info.name == "silent" for info in here.containers()))
    assert {info.name: info.protocol for info in here.containers()} == {"here": PROTOCOL, "silent": 0}
    assert here._parts.estop._others() == []  # none is reported as speaking another one
    transport.close()


def test_a_container_that_answered_in_another_version_is_not_asked_again(
    memory: MemorySystem, stranger: Strangers, eventually: Eventually
) -> None:
    here = memory.container("here")
    other = stranger()
    assert eventually(lambda: other.asked > 0)
    assert eventually(lambda: not here._parts.registry.left_open(other.address))
    memory.settle()
    asked = other.asked
    other.tell()
    memory.settle()
    assert other.asked == asked


ORDERS: Final[dict[str, tuple[Any, ...]]] = {
    "as they are now": (["abc", "tester/stranger/e1", "smoke", 1.5], []),
    "with more to it": (["abc", "tester/stranger/e1", "smoke", 1.5, {"zone": 2}], [], "more"),
    "the least of it": (["abc", "tester/stranger/e1"],),
    "the rest in other words": (["abc", "tester/stranger/e1", {"text": "smoke"}, "noon"], {"cleared": ["x"]}),
    "a long reason": (["abc", "tester/stranger/e1", "smoke" * 1000, float("nan")],),
}


@pytest.mark.parametrize("fields", ORDERS.values(), ids=list(ORDERS))
def test_S09_an_order_to_stop_is_obeyed_and_confirmed_whatever_its_version(
    memory: MemorySystem, stranger: Strangers, eventually: Eventually, fields: tuple[Any, ...]
) -> None:
    arm, other = arm_of(memory), stranger()
    one = memory.container("one")
    confirmed = MemoryTransport(memory.network, "ear").subscribe("estop/*/one/*")
    other.order("abc", *fields)
    assert eventually(lambda: arm.stopped == 1)
    assert msgpack.decode(confirmed.receive().payload or b"")[1:] == ["abc", ""]
    [estop] = one.estops()
    assert (estop.id, estop.by) == ("abc", "tester/stranger/e1")
    assert estop.reason in ("smoke", "", ("smoke" * 1000)[:500])
    with pytest.raises(Stopped):
        move(one)
    assert one.estop_clear(["abc"], limit_s=GENEROUS_S).confirmed == ("tester/one",)
    assert move(one) == "moved"


def test_an_order_to_clear_is_obeyed_in_its_own_version_only(
    memory: MemorySystem, stranger: Strangers, eventually: Eventually
) -> None:
    arm_of(memory)
    one, other = memory.container("one"), stranger()
    report = one.estop("smoke", limit_s=GENEROUS_S)
    dropped = one.dropped_messages
    other.order("c1ea12ed", None, [report.id])
    assert eventually(lambda: one.dropped_messages > dropped)
    assert [estop.id for estop in one.estops()] == [report.id]


@pytest.mark.parametrize(
    "fields",
    [
        ("abc", ["abc", "mallory/x/e", "", 0.0]),
        ("abc", ["abcd", "tester/x/e"]),
        ("../a", ["../a", "tester/x/e"]),
        ("abc", ["abc"]),
        ("abc", {"id": "abc", "by": "tester/x/e"}),
    ],
    ids=["another's name", "another request", "a path", "no client's", "another shape"],
)
def test_what_is_no_order_in_any_version_stops_nothing(
    memory: MemorySystem, stranger: Strangers, eventually: Eventually, fields: tuple[Any, ...]
) -> None:
    arm_of(memory)
    one, other = memory.container("one"), stranger()
    dropped = one.dropped_messages
    other.order(*fields)
    assert eventually(lambda: one.dropped_messages > dropped)
    assert one.estops() == []
    assert move(one) == "moved"


def test_S09_a_report_names_containers_of_another_version_that_confirmed(
    memory: MemorySystem, stranger: Strangers
) -> None:
    arm_of(memory)
    other, caller = stranger(), memory.container("caller")
    report = caller.estop("smoke", limit_s=GENEROUS_S)
    assert other.obeyed == [report.id]
    assert report.confirmed == ("tester/one", "tester/stranger")
    assert report.versions == {"tester/stranger": OTHER}
    assert report.complete


def test_S09_a_container_of_another_version_that_does_not_confirm_is_missing(
    memory: MemorySystem, stranger: Strangers
) -> None:
    arm_of(memory)
    stranger(obeys=False)
    report = memory.container("caller").estop("smoke", limit_s=0.3)
    assert (report.confirmed, report.missing) == (("tester/one",), ("tester/stranger",))
    assert report.versions == {"tester/stranger": OTHER}
    assert not report.complete


def test_a_clearing_names_containers_of_another_version_that_still_have_it_open(
    memory: MemorySystem, stranger: Strangers, eventually: Eventually
) -> None:
    arm_of(memory)
    other, caller = stranger(), memory.container("caller")
    report = caller.estop("smoke", limit_s=GENEROUS_S)
    other.tell([report.id, "tester/caller/e", "smoke", 1.5, "more"])
    state = caller._parts.registry._containers[other.address]
    assert eventually(lambda: bool(state.open_estops()))
    cleared = caller.estop_clear([report.id], limit_s=GENEROUS_S)
    assert "tester/one" in cleared.confirmed
    assert cleared.missing == ("tester/stranger",)
    assert cleared.versions == {"tester/stranger": OTHER}
    assert not cleared.complete
    assert move(memory.container("one")) == "moved"
    assert [estop.id for estop in caller.estops()] == [report.id]
    other.tell()
    assert eventually(lambda: caller.estops() == [])


def test_S09_a_joining_container_takes_over_what_containers_of_another_version_have_open(
    memory: MemorySystem, stranger: Strangers
) -> None:
    stranger(open_=(["abc", "bob/desk/e9", "spill", 1.5, "more"],))
    arm = arm_of(memory)
    one = memory.container("one")
    assert [(estop.id, estop.reason) for estop in one.estops()] == [("abc", "spill")]
    assert arm.stopped <= 1  # there was nothing to stop yet when it was heard
    with pytest.raises(Stopped, match="spill"):
        move(one)


def test_an_e_stop_whose_id_contains_a_path_is_dropped(
    memory: MemorySystem, stranger: Strangers, eventually: Eventually
) -> None:
    """Its id names a file."""
    arm_of(memory)
    one, other = memory.container("one"), stranger()
    before = one.dropped_messages
    other.tell(["../found", "tester/stranger/e1"])
    assert eventually(lambda: one.dropped_messages > before)
    memory.settle()
    assert one.estops() == []
    assert move(one) == "moved"


def test_signs_of_life_of_another_version_are_seen(memory: MemorySystem, stranger: Strangers) -> None:
    other = stranger()
    assert alive_key(other.address) in MemoryTransport(memory.network, "ear").present(ALIVE, GENEROUS_S)
