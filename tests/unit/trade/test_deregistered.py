"""Registering and deregistering from anywhere, through the middleware's own services."""

import contextlib

import pytest

from tests.support.waiting import wait_until
from trade import Container, Handle, service, where
from trade.errors import ConfigurationError, NoSuchService, ServiceGone

pytestmark = pytest.mark.virtual_time


class Lamp:
    @service(effect="read")
    def brightness(self) -> float:
        return 0.5


def switch(asker: Container, name: str, container: str) -> Handle:
    return asker.find(where(name=name, group="trade", container=container), wait_s=20)


@pytest.fixture
def lamp(there: Container) -> Lamp:
    lamp = Lamp()
    there.register(lamp, "hall", meta={"room": 3})
    return lamp


def brightness(asker: Container) -> Handle:
    return asker.find(where(name="brightness"), wait_s=20)


def test_a_provider_is_deregistered_and_registered_again_from_elsewhere(
    here: Container, there: Container, lamp: Lamp
) -> None:
    old = brightness(here)
    name = switch(here, "deregister", "there")(old)
    with pytest.raises(ServiceGone):
        old()
    [info] = switch(here, "withdrawn", "there")()
    assert (info.provider, info.kind, tuple(info.groups)) == (name, "Lamp", ("hall",))
    [new] = switch(here, "register", "there")(name)
    assert new() == 0.5
    assert (new.groups, dict(new.meta)) == (("hall",), {"room": 3})
    assert switch(here, "withdrawn", "there")() == []
    with pytest.raises(ServiceGone):
        old()


def test_it_may_come_back_in_other_groups(here: Container, there: Container, lamp: Lamp) -> None:
    name = there.system.deregister(brightness(there))
    there.system.register(name, ("attic", "upstairs.attic"))
    assert brightness(there).groups == ("attic", "upstairs.attic")
    assert here.find(where(group="upstairs"), wait_s=20)() == 0.5


def test_the_owner_has_the_last_word(there: Container, lamp: Lamp) -> None:
    name = there.system.deregister(brightness(there))
    there.deregister(lamp)
    assert there.system.withdrawn() == []
    with pytest.raises(ConfigurationError, match="there is none"):
        there.system.register(name)
    there.register(lamp, "hall")
    there.system.deregister(brightness(there))
    there.register(lamp, "hall")
    assert there.system.withdrawn() == []
    assert brightness(there)() == 0.5


def test_what_cannot_be_deregistered_says_why(here: Container, there: Container, lamp: Lamp) -> None:
    with pytest.raises(ConfigurationError, match=r"another container, .* call deregister of there"):
        here.system.deregister(brightness(here))
    clock = there.find(where(name="clock", container="there"))
    with pytest.raises(ConfigurationError, match="middleware's own"):
        there.system.deregister(clock)
    old = brightness(there)
    there.deregister(lamp)
    with pytest.raises(ConfigurationError, match="does not offer it"):
        there.system.deregister(old)
    with pytest.raises(NoSuchService):
        there.find(where(name="brightness"), wait_s=0)


def test_a_name_that_was_not_withdrawn_is_refused_with_those_that_were(
    here: Container, there: Container, lamp: Lamp
) -> None:
    name = there.system.deregister(brightness(there))
    with pytest.raises(ConfigurationError, match=f"there is {name}"):
        switch(here, "register", "there")("Lump-1")
    with pytest.raises(ConfigurationError, match="is no group"):
        switch(here, "register", "there")(name, ("trade.mine",))
    assert switch(here, "register", "there")(name)[0]() == 0.5


@pytest.mark.parametrize("where_it_is", ["local", "remote"])
def test_what_is_deregistered_while_it_is_looked_up_is_not_called_afterwards(
    here: Container, there: Container, lamp: Lamp, monkeypatch: pytest.MonkeyPatch, where_it_is: str
) -> None:
    caller = there if where_it_is == "local" else here
    handle, allowed, calls = brightness(caller), caller.access.require_call, list[None]()

    def meanwhile(*asked: str) -> None:
        allowed(*asked)
        if not calls:
            calls.append(None)
            there.deregister(lamp)
            wait_until(lambda: not handle.alive, "it is gone")

    monkeypatch.setattr(caller.access, "require_call", meanwhile)
    with contextlib.suppress(ServiceGone):
        handle()
    assert calls
    assert handle.key not in caller.client._known
    with pytest.raises(ServiceGone):
        handle()
