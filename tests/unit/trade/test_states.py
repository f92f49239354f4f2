"""The states of a container as services, and as events that notifications are about: each follows what it describes."""

import queue
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from tests.support.certificates import Papers
from tests.support.waiting import wait_until
from tests.unit.trade.rules_fixture import NOTE, Desk, Engine
from trade import Container, HookEvent, LinkInfo, NetworkInfo, StateEvent, service, where
from trade.errors import ConfigurationError
from trade.protocol.keys import DOMAIN
from trade.testing import MemorySystem
from trade.transport.endpoints import free_endpoint

pytestmark = pytest.mark.virtual_time


class Kitchen:
    """Does what a cook asks for, one thing after the other."""

    @service
    def fetch(self) -> None: ...

    @service
    def cook(self) -> None: ...

    @service
    def burn(self) -> None: ...

    @service(effect="read")
    def heat_k(self) -> float:
        return 370.0


class Diary:
    """Takes events; a service, so that another container can notify it."""

    def __init__(self) -> None:
        self._events: queue.SimpleQueue[StateEvent] = queue.SimpleQueue()

    @service
    def write(self, event: StateEvent) -> None:
        self._events.put(event)

    def next(self) -> tuple[str, str]:
        """What the next event was, and what about."""
        event = self._events.get(timeout=20)
        return event.kind, event.about

    @property
    def empty(self) -> bool:
        return self._events.empty()


@pytest.fixture
def diary() -> Diary:
    return Diary()


def asked(asking: Container, name: str, container: str, *args: Any) -> Any:
    """The state of a container, asked for as any service."""
    return asking.call(where(name=name, group=DOMAIN, container=container), *args)


def link(asking: Container, container: str, to: str) -> LinkInfo | None:
    """The link of one container to another; None if there is none."""
    info: NetworkInfo = asked(asking, "network", container)
    return next((one for one in info.links if one.to == to), None)


@pytest.mark.real_clock
def test_a_link_says_to_whom_it_leads_since_when_and_how_many_calls_were_answered(
    here: Container, there: Container
) -> None:
    there.register(Kitchen(), "kitchen")
    cook = here.find("kitchen.cook", wait_s=20)
    cook()
    wait_until(lambda: link(there, "here", "there"), "the link is listed")
    back, before = link(here, "there", "here"), link(there, "here", "there")
    assert before is not None
    assert back is not None
    assert (before.identity, before.bridge) == (there.address.identity, False)
    assert (before.here, before.there) == (back.there, back.here)
    assert before.dialled is not back.dialled
    for _ in range(7):
        cook()
    cook.start().result(20)
    after = link(there, "here", "there")
    assert after is not None
    assert after.calls == before.calls + 8
    assert after.linked_s > before.linked_s
    repeated = link(there, "here", "there")
    assert repeated is not None
    assert (repeated.calls, repeated.there) == (after.calls, after.there)


@pytest.mark.realtime
def test_a_link_that_is_cut_disappears_and_others_are_notified_of_its_end(
    here: Container, diary: Diary, start_program: Callable[..., Any]
) -> None:
    program = start_program("container = Container(Settings.read(container='far')); say('up'); hear()")
    assert program.heard() == "up"
    wait_until(lambda: link(here, "here", "far"), "the link is listed")
    here.occurred(["unlinked", "linked"], diary.write, about=where(container="far"))
    program.kill()
    wait_until(lambda: link(here, "here", "far") is None, "the link is not listed any more")
    assert diary.next() == ("unlinked", "far")


@pytest.mark.real_clock
def test_the_network_of_a_container_says_what_is_listened_on_dialled_searched_and_answered(
    start_container: Callable[..., Container], diary: Diary
) -> None:
    endpoint, nowhere = free_endpoint(), free_endpoint()
    one = start_container("one", listen=[endpoint])
    other = start_container("other", connect=[endpoint, nowhere])
    other.find(where(name="network", container="one"), wait_s=20)
    one.occurred(("discovery", "broadcast"), diary.write)

    def reach(name: str) -> NetworkInfo:
        return asked(other, "network", name)

    assert reach("one").listens == [endpoint]
    assert reach("other").dials == {endpoint: True, nowhere: False}
    assert [(reach(name).discovery, reach(name).broadcast) for name in ("one", "other")] == [(False, False)] * 2
    one.system.set_discovery(True)
    assert [(reach(name).discovery, reach(name).broadcast) for name in ("one", "other")] == [
        (True, False),
        (False, False),
    ]
    one.system.set_broadcast(True)
    one.system.set_discovery(True)  # no news
    assert (reach("one").discovery, reach("one").broadcast) == (True, True)
    one.system.set_discovery(False)
    assert (reach("one").discovery, reach("one").broadcast) == (False, True)
    assert [diary.next() for _ in range(3)] == [("discovery", "one"), ("broadcast", "one"), ("discovery", "one")]
    assert [event.text for event in asked(other, "state_events", "one") if event.about == "one"] == ["on", "on", "off"]


@pytest.mark.real_clock
def test_a_certificate_is_reported_with_its_end_and_without_its_key(
    start_container: Callable[..., Container], tmp_path: Path
) -> None:
    folder = Papers(tmp_path / "pki").of("arm")
    arm = start_container("arm", tls=folder)
    reach: NetworkInfo = asked(arm, "network", "arm")
    assert reach.certificate_ends == arm.settings.certificate().until.timestamp()
    assert datetime.fromtimestamp(reach.certificate_ends, timezone.utc) > datetime.now(timezone.utc)
    assert str(folder) not in repr(reach)


@pytest.mark.real_clock
def test_a_certificate_that_ends_soon_is_an_event(start_container: Callable[..., Container], tmp_path: Path) -> None:
    arm = start_container("arm", tls=Papers(tmp_path / "pki").of("arm", lasts=timedelta(hours=12)))
    assert [(one.kind, one.about) for one in asked(arm, "state_events", "arm")] == [("certificate_ends", "arm")]


def test_containers_that_join_and_leave_are_events(memory: MemorySystem, diary: Diary) -> None:
    base = memory.container("base")
    base.occurred(("container_joined", "container_left"), diary.write, about=where(container="rover"))
    memory.container("rover")
    memory.container("mast")
    assert diary.next() == ("container_joined", "rover")
    memory.container("rover").close()
    assert diary.next() == ("container_left", "rover")
    wait_until(lambda: [event.about for event in asked(base, "state_events", "base")] == ["rover", "mast", "rover"])
    assert diary.empty


def test_a_listener_of_a_stream_is_listed_until_it_leaves(memory: MemorySystem, diary: Diary) -> None:
    base, rover = memory.container("base"), memory.container("rover")
    rover.register(Kitchen(), "kitchen")
    rover.occurred(("listener_joined", "listener_left"), diary.write, about="kitchen")
    assert asked(base, "stream_listeners", "rover") == []
    with base.stream("kitchen.heat_k", hz=5.0):
        [info] = asked(base, "stream_listeners", "rover")
        assert (info.service, info.session, info.hz, info.on_change) == ("kitchen.heat_k", base.session, 5.0, False)
        assert 0 < info.left_s <= 10
        assert diary.next() == ("listener_joined", "kitchen.heat_k")
    wait_until(lambda: asked(base, "stream_listeners", "rover") == [])
    assert diary.next() == ("listener_left", "kitchen.heat_k")


def test_a_hook_that_is_suspended_says_so_to_a_third_container(memory: MemorySystem, diary: Diary) -> None:
    class Broken:
        @service(effect="read")
        def see(self, event: HookEvent) -> None:
            raise OSError("no film")

    base, rover, mind = (memory.container(name) for name in ("base", "rover", "mind"))
    rover.register(Kitchen(), "kitchen")
    base.register(Broken(), "camera")
    mind.register(diary, "diary")
    hook = base.after_service("kitchen.cook", base.find("camera.see"))
    mind.occurred("hook_suspended", mind.find("diary.write"), host="rover")
    for _ in range(3):
        base.call("kitchen.cook")
    assert diary.next() == ("hook_suspended", hook.id)
    [info] = asked(mind, "hooks", "rover")
    assert (info.suspended, info.last_error) == (True, "OSError: no film")


def test_what_a_rule_did_is_an_event(here: Container, desk: Desk, engine: Engine, diary: Diary) -> None:
    here.occurred("rule_fired", diary.write)
    engine(f"[rule.hello]\nwhen = {{ every_s = 0.02 }}\n{NOTE}\n")
    assert desk.next() == "x"
    assert diary.next() == ("rule_fired", "hello")


def test_P43_a_deviation_from_learned_sequences_is_a_service_and_a_notification(
    memory: MemorySystem, diary: Diary
) -> None:
    base, rover, mind = (memory.container(name) for name in ("base", "rover", "mind"))
    rover.register(Kitchen(), "kitchen")
    mind.register(diary, "diary")
    base.set_tracing(True, container="base")
    for name in ("fetch", "cook") * 3:
        base.call(f"kitchen.{name}")
    before = asked(mind, "call_profile", "base")
    assert (before.watched, before.deviations) == (False, [])
    usual = before.model
    assert usual.after == {"kitchen.fetch": {"kitchen.cook": 3}, "kitchen.cook": {"kitchen.fetch": 2}}
    assert asked(mind, "watch_calls", "base", usual) is False
    mind.occurred("call_deviated", mind.find("diary.write"), about="kitchen", host="base")
    for name in ("fetch", "cook", "fetch", "cook"):
        base.call(f"kitchen.{name}")
    after = asked(mind, "call_profile", "base")
    assert (after.watched, after.deviations) == (True, [])
    for name in ("burn", "fetch", "cook", "burn"):
        base.call(f"kitchen.{name}")
    assert [diary.next(), diary.next()] == [("call_deviated", "kitchen.burn"), ("call_deviated", "kitchen.fetch")]
    found = {(one.kind, one.before, one.after) for one in asked(mind, "call_profile", "base").deviations}
    found.discard(("new", "diary.write", "diary.write"))  # the notification calls, too
    assert found == {("new", "kitchen.cook", "kitchen.burn"), ("new", "kitchen.burn", "kitchen.fetch")}
    assert asked(mind, "watch_calls", "base", None) is True
    assert diary.empty  # neither usual calls nor the same deviation again


def test_calls_that_deviate_are_not_mixed_between_callers_nor_with_the_calls_inside_them(
    memory: MemorySystem, diary: Diary
) -> None:
    class Cook:
        @service
        def dinner(self) -> None:
            base.call("kitchen.burn")

    base, rover = memory.container("base"), memory.container("rover")
    rover.register(Kitchen(), "kitchen")
    base.register(Cook(), "cook")
    base.set_tracing(True, container="base")
    for _ in range(2):
        base.call("kitchen.fetch")
        base.call("cook.dinner")
    asked(base, "watch_calls", "base", asked(base, "call_profile", "base").model)
    base.occurred("call_deviated", diary.write)
    with base.open_session("page").use():
        base.call("kitchen.cook")  # of another session
    base.call("kitchen.fetch")
    base.call("cook.dinner")
    assert asked(base, "call_profile", "base").deviations == []
    base.call("kitchen.burn")
    assert diary.next() == ("call_deviated", "kitchen.burn")
    assert diary.empty


def test_an_occasion_without_or_with_an_unknown_event_is_refused(memory: MemorySystem, diary: Diary) -> None:
    base = memory.container("base")
    for events in ("exploded", ()):
        with pytest.raises(ConfigurationError, match="is not among broadcast, call_deviated"):
            base.occurred(events, diary.write)  # type: ignore[arg-type]
    assert base.notifications() == []


def test_an_event_notification_is_listed_and_cancelled_like_any_other(memory: MemorySystem, diary: Diary) -> None:
    base = memory.container("base")
    notification = base.occurred("container_joined", diary.write)
    [info] = base.notifications()
    assert (info.occasion, info.state) == ("container_joined", "standing")
    notification.cancel()
    memory.container("rover")
    wait_until(lambda: asked(base, "state_events", "base"), "the event is in the log")
    assert diary.empty


def test_events_are_read_from_a_number_on(memory: MemorySystem) -> None:
    base = memory.container("base")
    for name in ("rover", "mast"):
        memory.container(name)
    memory.settle()
    first, second = asked(base, "state_events", "base")
    assert (first.number, first.about, second.number, second.about) == (1, "rover", 2, "mast")
    assert asked(base, "state_events", "base", 1) == [second]
    assert asked(base, "state_events", "base", 2) == []
