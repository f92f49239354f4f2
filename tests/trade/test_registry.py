"""The registry: entries and signs of life in any order, each change told once and in order."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade._constraints import where
from trade._registry import Change, Registry
from trade._wire import Address, ProviderInfo, ServiceInfo, ServiceKey

OWN = Address("me", "here", "e0")
OTHER = Address("arm", "driver", "e1")


def info(revision: int = 1, *names: str, group: str = "rosie") -> ProviderInfo:
    services = tuple(ServiceInfo(name=name, signature=f"{name}()") for name in names or ("go",))
    return ProviderInfo(revision=revision, groups=(group,), kind="Arm", host="edge", pid=1, services=services)


class Told:
    def __init__(self, registry: Registry) -> None:
        self.changes: list[tuple[list[str], list[str], list[str]]] = []
        registry.listen(self.hear)

    def hear(self, change: Change) -> None:
        joined, left, replaced = ([record.name for record in records] for records in change[:3])
        self.changes.append((joined, left, replaced))


@pytest.fixture
def registry() -> Registry:
    return Registry(OWN)


@pytest.fixture
def told(registry: Registry) -> Told:
    return Told(registry)


def test_an_entry_before_the_sign_of_life_counts_when_that_rises(registry: Registry, told: Told) -> None:
    registry.put(OTHER, "rosie", "Arm-1", info())
    assert registry.select(where()) == []
    registry.appear(OTHER)
    assert told.changes == [(["go"], [], [])]


def test_an_entry_after_the_sign_of_life_counts_at_once(registry: Registry, told: Told) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "Arm-1", info())
    assert told.changes == [(["go"], [], [])]


def test_a_sign_of_life_that_falls_takes_the_services_along_and_brings_them_back(
    registry: Registry, told: Told
) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "Arm-1", info())
    registry.vanish(OTHER)
    assert registry.select(where()) == []
    registry.appear(OTHER)
    assert told.changes == [(["go"], [], []), ([], ["go"], []), (["go"], [], [])]


def test_signs_of_life_heard_twice_change_nothing(registry: Registry, told: Told) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "Arm-1", info())
    registry.appear(OTHER)
    registry.vanish(OTHER)
    registry.vanish(OTHER)
    assert told.changes == [(["go"], [], []), ([], ["go"], [])]


def test_entries_heard_twice_change_nothing(registry: Registry, told: Told) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "Arm-1", info())
    registry.put(OTHER, "rosie", "Arm-1", info())
    assert told.changes == [(["go"], [], [])]


def test_a_deregistered_provider_never_comes_back_in_that_boot(registry: Registry, told: Told) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "Arm-1", info())
    registry.remove(OTHER, "Arm-1")
    registry.put(OTHER, "rosie", "Arm-1", info(revision=2))
    registry.vanish(OTHER)
    registry.appear(OTHER)
    assert told.changes == [(["go"], [], []), ([], ["go"], [])]


def test_a_removal_heard_before_the_entry_holds(registry: Registry) -> None:
    registry.appear(OTHER)
    registry.remove(OTHER, "Arm-1")
    registry.put(OTHER, "rosie", "Arm-1", info())
    assert registry.select(where()) == []


def test_a_new_revision_tells_what_came_what_went_and_what_stayed(registry: Registry, told: Told) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "Arm-1", info(1, "a", "b"))
    registry.put(OTHER, "rosie", "Arm-1", info(2, "b", "c", group="lab"))
    assert told.changes[1] == (["c"], ["a"], ["b"])
    assert [record.groups for record in registry.select(where(name="b"))] == [("lab",)]


def test_an_older_revision_is_ignored(registry: Registry) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "Arm-1", info(2, "new"))
    registry.put(OTHER, "rosie", "Arm-1", info(1, "old"))
    assert [record.name for record in registry.select(where())] == ["new"]


def test_two_boots_of_one_container_are_two_containers(registry: Registry) -> None:
    again = Address(OTHER.identity, OTHER.container, "e2")
    for address in (OTHER, again):
        registry.appear(address)
        registry.put(address, "rosie", "Arm-1", info())
    registry.vanish(OTHER)
    assert [record.key.address for record in registry.select(where())] == [again]


def test_a_service_that_stays_through_a_new_revision_is_never_missing(registry: Registry) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "Arm-1", info())
    key = ServiceKey(OTHER, "rosie", "Arm-1", "go")
    missing, done = [], threading.Event()

    def look() -> None:
        while not done.is_set():
            if registry.get(key) is None:
                missing.append(True)

    looking = threading.Thread(target=look)
    looking.start()
    for revision in range(2, 2000):
        registry.put(OTHER, "rosie", "Arm-1", info(revision))
    done.set()
    looking.join()
    assert missing == []


def test_ended_containers_are_forgotten_in_the_end(registry: Registry) -> None:
    for boot in range(1000):
        address = Address("arm", "short-lived", f"e{boot}")
        registry.appear(address)
        registry.put(address, "rosie", "Arm-1", info())
        registry.vanish(address)
    assert len(registry._containers) < 300
    registry.appear(address)
    assert [record.name for record in registry.select(where())] == ["go"]


def test_waiting_ends_when_the_condition_holds_or_the_time_is_over(registry: Registry) -> None:
    assert not registry.wait_for(lambda: False, 0)
    coming = threading.Timer(0.02, lambda: registry.appear(OTHER))
    coming.start()
    assert registry.wait_for(lambda: registry.is_alive(OTHER), 20)
    coming.join()


_events = st.lists(
    st.tuples(
        st.sampled_from(["put", "remove", "appear", "vanish"]),
        st.sampled_from([OTHER, Address("arm", "driver", "e2")]),
        st.sampled_from(["Arm-1", "Arm-2"]),
        st.integers(1, 3),
    ),
    max_size=25,
)


@given(_events)
def test_what_was_told_adds_up_to_what_is_there(events: list[tuple[str, Address, str, int]]) -> None:
    registry = Registry(OWN)
    told: set[ServiceKey] = set()

    def hear(change: Change) -> None:
        joined, left = {record.key for record in change.joined}, {record.key for record in change.left}
        assert not joined & told, "came twice"
        assert left <= told, "left without having come"
        told.update(joined)
        told.difference_update(left)

    registry.listen(hear)
    for event, address, provider, revision in events:
        match event:
            case "put":
                registry.put(address, "rosie", provider, info(revision, "a", f"b{revision}"))
            case "remove":
                registry.remove(address, provider)
            case "appear":
                registry.appear(address)
            case _:
                registry.vanish(address)
    assert told == {record.key for record in registry.select(where())}
