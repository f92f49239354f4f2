"""Ten thousand services on the real transport: who listens and who comes late know all of them, and can call."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from trade import Container, Handle, service, where
from trade._discovery.announcer import Announcer
from trade.protocol.keys import Address
from trade.protocol.messages import ProviderInfo, ServiceInfo

HOST = Address("other", "host", "e1")


def entry(revision: int, services: int) -> ProviderInfo:
    infos = tuple(ServiceInfo(name=f"press_{number}", signature="press()") for number in range(services))
    return ProviderInfo(revision=revision, groups=("panels",), kind="Panel", host="h", pid=1, services=infos)


@pytest.fixture
def host(here: Container, open_raw: Any) -> Iterator[Announcer]:
    """Announces whatever a test wants; linked with the container, for which it is alive."""
    raw = open_raw(here)
    announcer = Announcer(raw, HOST)
    sign = announcer.appear()
    assert here._parts.registry.wait_for(lambda: here._parts.registry.is_alive(HOST), 20)
    yield announcer
    sign.close()
    announcer.close()


@pytest.mark.parametrize(("providers", "services"), [(10_000, 1), (1000, 10)])
def test_ten_thousand_services_are_known_to_running_and_to_late_containers(
    here: Container, start_container: Any, host: Announcer, eventually: Any, providers: int, services: int
) -> None:
    for revision in range(1, providers + 1):
        host.announce("panels", f"p{revision}", entry(revision, services))
    assert eventually(lambda: len(here.services(where(group="panels"))) == 10_000)
    late = start_container("late")
    assert eventually(lambda: len(late.services(where(group="panels"))) == 10_000)


def test_a_late_container_knows_the_services_left_after_most_were_withdrawn(
    here: Container, start_container: Any, host: Announcer, eventually: Any
) -> None:
    for revision in range(1, 2001):
        host.announce("panels", f"p{revision}", entry(revision, 1))
    for revision in range(2001, 4000):
        host.announce("panels", f"p{revision - 2000}", entry(revision, 0))
    late = start_container("late")
    for container in (here, late):
        assert eventually(lambda container=container: len(container.services(where(group="panels"))) == 1)
        [left] = container.services(where(group="panels"))
        assert left.key.provider == "p2000"


def test_lost_entries_are_requested_when_the_container_reports_its_revision(
    here: Container, host: Announcer, monkeypatch: pytest.MonkeyPatch, eventually: Any
) -> None:
    host.announce("panels", "p1", entry(1, 1))
    assert eventually(lambda: len(here.services(where(group="panels"))) == 1)
    with monkeypatch.context() as lossy:
        lossy.setattr(host._transport, "announce", lambda key, payload: None)
        host.announce("panels", "p2", entry(2, 1))
        host.announce("panels", "p1", entry(3, 0))
    host.beat(2)
    assert eventually(lambda: [handle.key.provider for handle in here.services(where(group="panels"))] == ["p2"])


class Panel:
    @service
    def press(self, value: int) -> int:
        return value


@pytest.mark.parametrize("late", [False, True])
def test_an_immediate_call_to_a_new_service_is_answered(
    here: Container, there: Container, start_container: Callable[[str], Container], eventually: Any, late: bool
) -> None:
    """The callee listens before it announces; whether one hears of it from an announcement or from an answer."""
    pressed: list[int] = []

    def press(handle: Handle) -> None:
        pressed.append(handle.with_(deadline_s=20)(1))

    def register() -> None:
        for number in range(100):
            there.register(Panel(), f"panel.p{number}")

    if late:
        register()
        caller = start_container("caller")
    else:
        caller = here
    notification = caller.joined(where(name="press"), press, existing=True)
    if not late:
        register()
    assert eventually(lambda: len(pressed) == 100)
    notification.cancel()
    assert pressed == [1] * 100
