"""Looking services up: one that matches, all that match, none."""

import threading
from typing import Any

import pytest

from trade import Container, service, where
from trade.errors import NoSuchService, TooManyServices

pytestmark = pytest.mark.virtual_time


class Arm:
    @service
    def move_to(self, angle_rad: float) -> None: ...

    @service(effect="read")
    def angle(self) -> float:
        return 0.5


def test_services_without_a_constraint_lists_everything_in_order(here: Container) -> None:
    here.register(Arm(), "rosie.arm")
    labels = [handle.label for handle in here.services()]
    assert labels == sorted(labels)
    assert labels[:3] == ["rosie.arm.angle", "rosie.arm.move_to", "trade.acquire"]


def test_services_lists_what_matches(here: Container) -> None:
    here.register(Arm(), "rosie.left")
    here.register(Arm(), "rosie.right")
    here.register(Arm(), "bob")
    assert [handle.label for handle in here.services(where(name="angle", group="rosie"))] == [
        "rosie.left.angle",
        "rosie.right.angle",
    ]


def test_a_new_container_knows_existing_services_immediately(start_container) -> None:  # type: ignore[no-untyped-def]
    start_container("there").register(Arm(), "rosie")
    assert [handle.name for handle in start_container("here").services(where(group="rosie"))] == ["angle", "move_to"]


def test_no_match_is_an_error_that_says_what_was_asked(here: Container) -> None:
    with pytest.raises(NoSuchService, match=r"no service matches name='fly' after 0 s\. No services are") as none:
        here.find(where(name="fly"), wait_s=0)
    assert isinstance(none.value, LookupError)


def test_no_match_says_which_groups_there_are_instead(here: Container) -> None:
    here.register(Arm(), ["rosie.arm", "blue"])
    with pytest.raises(NoSuchService, match=r"\. This system has blue, rosie\.arm; `trade services` lists their"):
        here.find(where(name="fly"), wait_s=0)


def test_no_match_hints_at_what_looks_alike(here: Container) -> None:
    here.register(Arm(), "rosie.arm")
    with pytest.raises(NoSuchService) as none:
        here.find(where(name="move_two", group="rosie.arm"), wait_s=0)
    assert none.value.near == ("rosie.arm.move_to",)
    assert str(none.value).endswith(". Did you mean rosie.arm.move_to?")


def test_a_group_that_looks_alike_is_hinted_at(here: Container) -> None:
    here.register(Arm(), "rosie.arm")
    with pytest.raises(NoSuchService, match=r"Did you mean rosie\.arm\?"):
        here.find(where(group="rosie.amr"), wait_s=0)


class Wheel:
    @service
    def step(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.mark.parametrize(
    ("asked", "near"), [("stap", ("rosie.step",)), ("stpo", ("rosie.step",)), ("sop", ("rosie.stop",))]
)
def test_a_stop_is_hinted_at_only_where_nothing_else_is_near(
    here: Container, asked: str, near: tuple[str, ...]
) -> None:
    here.register(Wheel(), "rosie")
    with pytest.raises(NoSuchService) as none:
        here.find(where(name=asked, group="rosie"), wait_s=0)
    assert none.value.near == near


def test_two_matches_are_an_error_that_names_them(here: Container, there: Container) -> None:
    here.register(Arm(), "rosie")
    there.register(Arm(), "rosie")
    here.find(where(name="angle", container="there"), wait_s=20)
    with pytest.raises(TooManyServices) as many:
        here.find(where(name="angle"))
    assert list(many.value.matches) == ["rosie.angle in here", "rosie.angle in there"]
    assert "Add a constraint on what distinguishes them (container)" in str(many.value)


def test_an_ambiguous_lookup_distinguishes_objects_of_the_same_group(here: Container) -> None:
    here.register(Arm(), "rosie")
    here.register(Arm(), "rosie")
    with pytest.raises(TooManyServices, match="Register them in different groups or with different meta") as many:
        here.find(where(name="angle"))
    assert list(many.value.matches) == ["rosie.angle of Arm-1 in here", "rosie.angle of Arm-2 in here"]


def test_an_ambiguous_lookup_distinguishes_containers_of_the_same_name(here: Container, start_container: Any) -> None:
    twins = [start_container("twin"), start_container("twin")]
    for twin in twins:
        twin.register(Arm(), "rosie")
    assert here._parts.registry.wait_for(lambda: len(here.services(where(name="angle"))) == 2, 20)
    with pytest.raises(TooManyServices) as many:
        here.find(where(name="angle"))
    assert sorted(many.value.matches) == sorted(f"rosie.angle of Arm-1 in {twin.address}" for twin in twins)


def test_find_waits_for_a_service_that_comes_late(here: Container, there: Container) -> None:
    coming = threading.Timer(0.05, lambda: there.register(Arm(), "late"))
    coming.start()
    assert here.find(where(name="angle", group="late"), wait_s=20)() == 0.5
    coming.join()


def test_the_containers_of_the_system_are_listed(here: Container, there: Container) -> None:
    there.register(Arm(), "rosie")
    here.find(where(name="angle"), wait_s=20)
    own = len(there.services(where(group="trade", local=True)))

    def known() -> tuple[int, int, str]:
        infos = {info.name: info for info in here.containers()}
        assert set(infos) == {"here", "there"}
        return (infos["there"].providers, infos["there"].services, infos["there"].epoch)

    # what it offers comes one after the other
    assert here._parts.registry.wait_for(lambda: known() == (3, 2 + own, there.address.epoch), 20), known()


def test_a_closed_container_is_no_longer_listed(here: Container, there: Container) -> None:
    assert {info.name for info in here.containers()} >= {"here"}
    there.close()
    assert here._parts.registry.wait_for(lambda: [info.name for info in here.containers()] == ["here"], 20)


def test_systems_on_one_host_do_not_see_each_other(here: Container) -> None:
    from trade import Settings

    here.register(Arm(), "rosie")
    with Container(Settings.read(system="another-system", container="stranger")) as stranger:
        assert [info.name for info in stranger.containers()] == ["stranger"]
        assert stranger.services(where(group="rosie")) == []
        assert [info.name for info in here.containers()] == ["here"]
