"""Groups as objects: services and groups are attributes."""

import copy
import gc
import pickle
from collections.abc import Callable
from typing import Protocol

import pytest

from tests.support.waiting import wait_until
from trade import Container, GroupView, Handle, service, where
from trade.errors import ConfigurationError, NoSuchService, ServiceGone, TooManyServices
from trade.testing import MemorySystem, memory_system

pytestmark = pytest.mark.virtual_time


class Head:
    def __init__(self) -> None:
        self.moved: list[list[float]] = []

    @service
    def move_to(self, positions_rad: list[float]) -> None:
        """Moves the joints there."""
        self.moved.append(positions_rad)

    @service(effect="read", achieves=())
    def limits(self) -> list[float]:
        return [-1.4, 1.4]


class Moving(Protocol):
    """What a head has, as a type."""

    @service
    def move_to(self, positions_rad: list[float]) -> None: ...
    @service(effect="read")
    def limits(self) -> list[float]: ...


class Importer:
    @service
    def lambda_(self) -> str:
        return "lambda_"

    def find_it(self) -> str:
        return "found"


@pytest.fixture
def system() -> MemorySystem:  # type: ignore[misc]
    with memory_system() as system:
        yield system  # type: ignore[misc]


@pytest.fixture
def me(system: MemorySystem) -> Container:
    return system.container("me")


Offer = Callable[..., None]


@pytest.fixture
def offer(system: MemorySystem, me: Container) -> Offer:
    """Registers a provider in another container, and waits until ``me`` has its services."""

    def offer(provider: object, *groups: str, container: str = "edge") -> None:
        handles = system.container(container).register(provider, *groups)
        wait_until(lambda: all(me.client.has(handle.key) for handle in handles))

    return offer


def test_services_and_groups_are_attributes(me: Container, offer: Offer) -> None:
    head, pan = Head(), Head()
    offer(head, "rosie.head")
    offer(pan, "rosie.neck.pan")
    rosie = me.robot("rosie")
    rosie.head.move_to([0.3, -0.2])
    assert head.moved == [[0.3, -0.2]]
    assert rosie.neck.pan.limits() == [-1.4, 1.4]
    assert pan.moved == []


def test_an_attribute_is_the_handle_that_find_returns(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie.head")
    found = me.robot("rosie").head.move_to
    assert isinstance(found, Handle)
    assert found == me.find(where(name="move_to", group="rosie.head"))


def test_what_is_beneath_is_completed(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie.head")
    offer(Head(), "rosie.neck.pan")
    rosie = me.robot("rosie")
    assert {"head", "neck"} <= set(dir(rosie))
    assert {"move_to", "limits"} <= set(dir(rosie.head))
    assert "move_to" not in dir(rosie)
    assert repr(rosie) == "<GroupView rosie: head, neck>"


def test_what_joins_later_is_an_attribute_too(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie.head")
    rosie = me.robot("rosie")
    offer(Head(), "rosie.hand")
    assert rosie.hand.limits() == [-1.4, 1.4]


def test_a_misspelt_attribute_is_an_attribute_error_that_suggests_the_right_one(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie.head")
    rosie = me.robot("rosie", wait_s=0)
    with pytest.raises(NoSuchService, match=r"Did you mean rosie\.head\?") as wrong:
        _ = rosie.heat
    assert isinstance(wrong.value, AttributeError)
    with pytest.raises(NoSuchService, match=r"Did you mean rosie\.head\.move_to\?"):
        rosie.head.moveto([0.0, 0.0])
    assert not hasattr(rosie, "arm")


def test_a_group_without_services_is_refused(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie.head")
    with pytest.raises(NoSuchService, match="rosie"):
        me.robot("rosi", wait_s=0)
    with pytest.raises(ConfigurationError, match=r"trade\.robot.*use words joined by dots"):
        me.robot("rosie..head", wait_s=0)
    with pytest.raises(ConfigurationError, match=r"trade\.robot"):
        me.robot(7)  # type: ignore[arg-type]


def test_a_service_of_two_robots_of_one_name_is_refused(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie.head")
    offer(Head(), "rosie.head", container="other")
    rosie = me.robot("rosie")
    with pytest.raises(TooManyServices, match="edge"):
        _ = rosie.head.move_to


def test_an_attribute_that_is_a_service_and_a_group_is_refused(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie")
    offer(Head(), "rosie.limits")
    with pytest.raises(ConfigurationError, match=r"is a service and a group; write trade\.find\('rosie\.limits'\)"):
        _ = me.robot("rosie").limits


def test_names_that_are_no_identifiers_are_indexes_and_words_of_python_get_an_underscore(
    me: Container, offer: Offer
) -> None:
    offer(Head(), "rosie.left-arm")
    offer(Head(), "rosie.class")
    offer(Importer(), "rosie.tool")
    rosie = me.robot("rosie")
    assert rosie["left-arm"].limits() == [-1.4, 1.4]
    assert rosie["left-arm.limits"]() == [-1.4, 1.4]
    assert rosie.class_.limits() == [-1.4, 1.4]
    assert rosie.tool.lambda_() == "lambda_"
    assert "class_" in dir(rosie)
    with pytest.raises(ConfigurationError, match="an index is a name"):
        _ = rosie[0]  # type: ignore[index]


@pytest.mark.parametrize("typed", [False, True])
def test_after_a_restart_an_attribute_follows_if_that_was_chosen(
    me: Container, offer: Offer, system: MemorySystem, *, typed: bool
) -> None:
    first = Head()
    offer(first, "rosie.head", container="edge")

    def head(*, follow: bool) -> GroupView:
        return me.find(Head, follow=follow) if typed else me.robot("rosie", follow=follow).head  # type: ignore[no-any-return]

    staying, following = head(follow=False), head(follow=True)
    staying.move_to([0.1])
    following.move_to([0.2])
    system.kill("edge")
    again = Head()
    offer(again, "rosie.head", container="edge")
    system.advance(3.0)
    following.move_to([0.3])
    with pytest.raises(ServiceGone):
        staying.move_to([0.4])
    assert (first.moved, again.moved) == ([[0.1], [0.2]], [[0.3]])


def test_a_followed_group_that_nothing_uses_leaves_nothing(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie.head")
    subscribers = me._parts.registry.changes._subscribers
    before = len(subscribers)
    rosie = me.robot("rosie", follow=True)
    rosie.head.limits()
    assert len(subscribers) == before + 1
    del rosie
    gc.collect()
    assert len(subscribers) == before


def test_a_group_that_has_gone_fails_typed(me: Container, offer: Offer, system: MemorySystem) -> None:
    head = Head()
    offer(head, "rosie.head")
    rosie = me.robot("rosie", wait_s=0)
    rosie.head.limits()
    system.container("edge").deregister(head)
    wait_until(lambda: not me.services("rosie"))
    with pytest.raises(ServiceGone):
        rosie.head.limits()
    with pytest.raises(NoSuchService):
        _ = rosie.head.move_to


@pytest.mark.parametrize("do", [copy.deepcopy, pickle.dumps])
def test_a_group_cannot_be_copied_to_elsewhere(me: Container, offer: Offer, do: Callable[[object], object]) -> None:
    offer(Head(), "rosie.head")
    with pytest.raises(TypeError, match="belongs to its container"):
        do(me.robot("rosie"))


def test_a_group_cannot_be_changed(me: Container, offer: Offer) -> None:
    offer(Head(), "rosie.head")
    with pytest.raises(AttributeError, match="registered by their providers"):
        me.robot("rosie").head = 3


def test_a_class_finds_its_provider(me: Container, offer: Offer) -> None:
    head = Head()
    offer(head, "rosie.head")
    offer(Importer(), "rosie.tool")
    me.find(Head).move_to([0.5])
    assert head.moved == [[0.5]]
    assert not hasattr(me.find(Head, wait_s=0), "lambda_")


def test_an_interface_finds_the_provider_of_its_group(me: Container, offer: Offer) -> None:
    head, other = Head(), Head()
    offer(head, "rosie.head")
    offer(other, "rosie.hand")
    with pytest.raises(TooManyServices, match=r"rosie\.hand.*rosie\.head"):
        me.find(Head)
    me.find(Head, group="rosie.head").move_to([0.5])
    assert (head.moved, other.moved) == ([[0.5]], [])
    with pytest.raises(NoSuchService, match="kind='Moving'"):
        me.find(Moving, group="rosie.head", wait_s=0)


def test_a_provider_of_exactly_that_group_comes_first(me: Container, offer: Offer) -> None:
    head, beneath = Head(), Head()
    offer(head, "rosie.head")
    offer(beneath, "rosie.head.left")
    me.find(Head, group="rosie.head").move_to([0.5])
    assert (head.moved, beneath.moved) == ([[0.5]], [])


def test_a_class_in_one_of_two_containers(me: Container, offer: Offer) -> None:
    head, other = Head(), Head()
    offer(head, "rosie.head")
    offer(other, "emma.head", container="other")
    me.find(Head, container="other").move_to([0.5])
    assert (head.moved, other.moved) == ([], [[0.5]])


def test_a_provider_without_a_group_is_found_by_its_class(me: Container, offer: Offer) -> None:
    offer(Head())
    assert me.find(Head).limits() == [-1.4, 1.4]
