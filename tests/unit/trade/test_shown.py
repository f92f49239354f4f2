"""What shells and notebooks show: tables of services, containers and locks, and locks that name what they are of."""

import copy
import pickle
from collections.abc import Iterator
from html.parser import HTMLParser

import pytest

from tests.support.waiting import wait_until
from trade import Container, Table, service
from trade.testing import MemorySystem, memory_system

pytestmark = pytest.mark.virtual_time


class Head:
    @service
    def move_to(self, angle_rad: float) -> None: ...

    @service(effect="read")
    def state(self) -> float:
        return 0.0


class Cells(HTMLParser):
    """The texts of a table's cells, and its tags."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.texts: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.fixture
def system() -> Iterator[MemorySystem]:
    with memory_system() as system:
        yield system


@pytest.fixture
def me(system: MemorySystem) -> Container:
    """A container that knows a head in another one."""
    handles = system.container("edge").register(Head(), "rosie.head")
    me = system.container("me")
    wait_until(lambda: all(me.client.has(handle.key) for handle in handles))
    return me


def test_services_are_a_table_in_a_shell_and_in_a_notebook(me: Container) -> None:
    found = me.services("rosie")
    head, first, second = repr(found).splitlines()
    assert head.split() == ["SERVICE", "CALLED", "AS", "EFFECT", "HEALTH", "CONTAINER", "HOST"]
    assert first.split()[:1] + second.split()[:1] == ["rosie.head.move_to", "rosie.head.state"]
    cells = Cells(found._repr_html_())
    assert {"rosie.head.move_to", "move_to(angle_rad: float) -> None", "actuate", "edge"} <= set(cells.texts)
    assert cells.tags == {"table", "thead", "tbody", "tr", "th", "td"}


def test_a_table_is_a_list(me: Container) -> None:
    found = me.services("rosie")
    assert isinstance(found, list)
    assert found == list(found)
    assert [handle.name for handle in found] == ["move_to", "state"]
    assert found[0] == me.find("rosie.head.move_to")
    assert repr(me.services("emma")) == "[]"


def test_containers_are_a_table(me: Container) -> None:
    shown = me.containers()
    assert [line.split()[0] for line in repr(shown).splitlines()] == ["CONTAINER", "edge", "me"]
    assert {"edge", "me"} <= set(Cells(shown._repr_html_()).texts)


def test_locks_are_a_table(me: Container) -> None:
    with me.lock("rosie.head", purpose="look left"):
        shown = me.locks()
    _, line = repr(shown).splitlines()
    assert "look left" in line
    assert me.address.who in line
    assert "look left" in Cells(shown._repr_html_()).texts


def test_a_table_can_be_copied_and_pickled(me: Container) -> None:
    shown = me.containers()
    for copied in (copy.copy(shown), copy.deepcopy(shown), pickle.loads(pickle.dumps(shown))):
        assert copied == shown
        assert repr(copied) == repr(shown)


def test_the_texts_of_others_are_escaped(me: Container) -> None:
    with me.lock("rosie.head", purpose="<script>alert(1)</script>\x1b[2J\n"):
        shown = me.locks()
    cells = Cells(shown._repr_html_())
    assert "script" not in cells.tags
    assert any("<script>" in text for text in cells.texts)
    assert "\x1b" not in repr(shown)
    assert len(repr(shown).splitlines()) == 2


def test_a_table_without_columns_shows_itself_as_a_list() -> None:
    assert repr(Table([1, 2])) == "[1, 2]"


def test_a_lock_says_what_it_is_of_and_whether_it_is_held(me: Container) -> None:
    lock = me.lock("rosie.head")
    assert repr(lock) == "<Lock of rosie.head, not held>"
    with lock:
        assert repr(lock) == f"<Lock of {', '.join(lock.resources)}, held>"
    assert repr(lock) == "<Lock of rosie.head, released>"


def test_a_lock_of_handles_names_these(me: Container) -> None:
    assert repr(me.lock([me.find("rosie.head.move_to")])) == "<Lock of rosie.head.move_to, not held>"


def test_a_lock_that_waits_is_not_held(me: Container, system: MemorySystem) -> None:
    other = system.container("other")
    wait_until(lambda: len(other.services("rosie")) == 2)
    lock = other.lock("rosie.head", wait_s=0)
    with me.lock("rosie.head"), pytest.raises(Exception, match="locked"):
        lock.acquire()
    assert repr(lock) == "<Lock of rosie.head, not held>"
