"""``joined`` and ``left``: on this occasion, make that call."""

import queue
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Container, Handle, service, where
from trade.errors import ConfigurationError, ServiceGone

pytestmark = pytest.mark.virtual_time


class Lamp:
    @service
    def switch(self) -> None: ...


class Listener:
    """Hears names, one after the other."""

    def __init__(self) -> None:
        self.heard: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def __call__(self, handle: Handle) -> None:
        self.heard.put(handle)

    def next(self) -> Any:
        return self.heard.get(timeout=20)

    @service
    def tell(self, handle: Handle) -> None:
        self.heard.put(handle)


@pytest.fixture
def listener() -> Listener:
    return Listener()


def test_joined_reports_new_services(here: Container, there: Container, listener: Listener) -> None:
    here.joined(where(name="switch"), listener)
    there.register(Lamp(), "hall")
    assert listener.next().label == "hall.switch"


def test_joined_reports_own_services_too(here: Container, listener: Listener) -> None:
    here.joined(where(name="switch"), listener)
    here.register(Lamp(), "hall")
    assert listener.next().local


def test_joined_reports_only_matching_services(here: Container, listener: Listener) -> None:
    here.joined(where(name="switch", group="attic"), listener)
    here.register(Lamp(), "hall")
    here.register(Lamp(), "attic")
    assert listener.next().label == "attic.switch"


def test_joined_reports_nothing_that_existed_before(here: Container, listener: Listener) -> None:
    here.register(Lamp(), "before")
    here.joined(where(name="switch"), listener)
    here.register(Lamp(), "after")
    assert listener.next().label == "after.switch"


def test_joined_with_existing_first_reports_each_existing_service_once(here: Container, listener: Listener) -> None:
    here.register(Lamp(), "before")
    here.joined(where(name="switch"), listener, existing=True)
    here.register(Lamp(), "after")
    assert [listener.next().label for _ in range(2)] == ["before.switch", "after.switch"]
    assert listener.heard.empty()


def test_left_reports_removed_services_with_a_dead_handle(
    here: Container, there: Container, listener: Listener
) -> None:
    lamp = Lamp()
    there.register(lamp, "hall")
    here.find(where(name="switch"), wait_s=20)
    here.left(where(name="switch"), listener)
    there.deregister(lamp)
    gone = listener.next()
    assert (gone.label, gone.alive) == ("hall.switch", False)
    with pytest.raises(ServiceGone):
        gone()


def test_left_reports_services_of_a_closed_container(here: Container, there: Container, listener: Listener) -> None:
    there.register(Lamp(), "hall")
    here.find(where(name="switch"), wait_s=20)
    here.left(where(group="hall"), listener)
    there.close()
    assert listener.next().label == "hall.switch"


def test_a_cancelled_notification_does_not_fire(here: Container, listener: Listener) -> None:
    other = Listener()
    notification = here.joined(where(name="switch"), listener)
    here.joined(where(name="switch"), other)
    notification.cancel()
    notification.cancel()
    here.register(Lamp(), "hall")
    other.next()
    assert listener.heard.empty()
    assert not notification.active


def test_notifications_end_with_their_container(here: Container, listener: Listener) -> None:
    notification = here.joined(where(name="switch"), listener)
    here.close()
    assert not notification.active


@pytest.mark.parametrize("failure", [ValueError("no"), SystemExit(1)])
def test_a_failing_callback_kills_nothing(
    here: Container, listener: Listener, caplog: pytest.LogCaptureFixture, failure: BaseException
) -> None:
    failed = []

    def fail(handle: Handle) -> None:
        failed.append(handle.label)
        raise failure

    notification = here.joined(where(name="switch"), fail)
    here.joined(where(name="switch"), listener)
    here.register(Lamp(), "one")
    here.register(Lamp(), "two")
    assert [listener.next().label for _ in range(2)] == ["one.switch", "two.switch"]
    wait_until(lambda: failed == ["one.switch", "two.switch"] and notification.info().failures == 2)
    assert notification.active
    assert "the call of <Notification joined name='switch'> failed" in caplog.text


def test_a_service_may_get_notifications(here: Container, there: Container, listener: Listener) -> None:
    there.register(listener, "ears")
    here.joined(where(name="switch"), here.find(where(name="tell"), wait_s=20))
    here.register(Lamp(), "hall")
    assert listener.next().label == "hall.switch"


def test_a_callback_may_call_services_and_register_more(here: Container, there: Container, listener: Listener) -> None:
    def react(handle: Handle) -> None:
        handle()
        here.register(Lamp(), "reaction")
        listener(handle)

    here.joined(where(name="switch", container="there"), react)
    there.register(Lamp(), "hall")
    listener.next()
    assert here.find(where(group="reaction")).local


def test_what_cannot_be_called_is_refused(here: Container) -> None:
    with pytest.raises(
        ConfigurationError,
        match=r"trade.joined: call must be a handle, .*, a function, or a text such as 'rosie.head.stop', not 7",
    ):
        here.joined(where(), 7)  # type: ignore[arg-type]


def test_consultants_are_asked_as_they_come_and_go(start_container: Any, listener: Listener) -> None:
    """The paper's pattern: a component keeps a handle of every knowledge base, whenever it joins or leaves."""

    class KnowledgeBase:
        def __init__(self, name: str) -> None:
            self.name = name

        @service(effect="read")
        def get_kb_name(self) -> str:
            return self.name

    class Reference:
        """Its two services are what the notifications call."""

        def __init__(self) -> None:
            self.consultants: dict[Handle, str] = {}

        @service
        def new_consultant(self, handle: Handle) -> None:
            self.consultants[handle] = handle()
            listener(handle)

        @service
        def lost_consultant(self, handle: Handle) -> None:
            self.consultants.pop(handle)
            listener(handle)

    reference, main = Reference(), start_container("main")
    objects = KnowledgeBase("objects")
    main.register(objects, "kb")
    new, lost = main.register(reference, "reference")
    main.joined(where(name="get_kb_name"), new, existing=True)
    main.left(where(name="get_kb_name"), lost)
    listener.next()
    people = start_container("people")
    people.register(KnowledgeBase("people"), "kb")
    listener.next()
    assert sorted(reference.consultants.values()) == ["objects", "people"]
    main.deregister(objects)
    listener.next()
    people.close()
    listener.next()
    assert reference.consultants == {}
