"""The registry: announcements, answers and signs of life in any order, each change reported once and in order."""

import threading

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade._registry.constraints import where
from trade._registry.registry import Change, Registry
from trade.protocol.keys import Address, ServiceKey
from trade.protocol.messages import ProviderInfo, ServiceInfo

OWN = Address("me", "here", "e0")
OTHER = Address("arm", "driver", "e1")


def gone(revision: int) -> ProviderInfo:
    return msgspec.structs.replace(info(revision), services=())


def info(revision: int = 1, *names: str, group: str = "rosie") -> ProviderInfo:
    services = tuple(ServiceInfo(name=name, signature=f"{name}()") for name in names or ("go",))
    return ProviderInfo(revision=revision, groups=(group,), kind="Arm", host="edge", pid=1, services=services)


class Reports:
    def __init__(self, registry: Registry) -> None:
        self.changes: list[tuple[list[str], list[str], list[str]]] = []
        registry.changes.subscribe(self.hear)

    def hear(self, change: Change) -> None:
        joined, left, replaced = ([record.name for record in records] for records in change[:3])
        self.changes.append((joined, left, replaced))


@pytest.fixture
def registry() -> Registry:
    return Registry(OWN)


@pytest.fixture
def reported(registry: Registry) -> Reports:
    return Reports(registry)


def answer(registry: Registry, revision: int, **offered: ProviderInfo) -> None:
    """The other container reports all that it offered at a revision."""
    [state] = [state for state in registry.containers() if state.address == OTHER]
    registry.settle(state, revision, {name: ("rosie", entry) for name, entry in offered.items()})


def test_an_entry_counts_only_while_its_owner_is_alive(registry: Registry, reported: Reports) -> None:
    registry.put(OTHER, "rosie", "arm", info())
    assert registry.select(where()) == []
    assert registry.appear(OTHER)
    assert reported.changes == []
    answer(registry, 1, arm=info())
    assert reported.changes == [(["go"], [], [])]


def test_an_entry_after_the_sign_of_life_counts_at_once(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info())
    assert reported.changes == [(["go"], [], [])]


def test_a_sign_of_life_that_falls_takes_the_services_along(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info())
    registry.vanish(OTHER)
    assert registry.select(where()) == []
    assert registry.appear(OTHER)
    answer(registry, 1, arm=info())
    assert reported.changes == [(["go"], [], []), ([], ["go"], []), (["go"], [], [])]


def test_signs_of_life_heard_twice_change_nothing(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info())
    assert not registry.appear(OTHER)
    registry.vanish(OTHER)
    registry.vanish(OTHER)
    assert reported.changes == [(["go"], [], []), ([], ["go"], [])]


def test_entries_heard_twice_change_nothing(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info())
    registry.put(OTHER, "rosie", "arm", info())
    answer(registry, 1, arm=info())
    registry.put(OTHER, "rosie", "arm", info())
    assert reported.changes == [(["go"], [], [])]


def test_a_deregistered_provider_never_comes_back_in_that_boot(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info())
    registry.put(OTHER, "rosie", "arm", gone(2))
    answer(registry, 1, arm=info())
    registry.put(OTHER, "rosie", "arm", info(3))
    assert reported.changes == [(["go"], [], []), ([], ["go"], [])]


def left_open(registry: Registry) -> bool:
    return registry.left_open(OTHER)


def test_a_container_that_appeared_is_to_be_asked_once(registry: Registry) -> None:
    assert not left_open(registry)
    registry.appear(OTHER)
    assert left_open(registry)
    answer(registry, 2, arm=info(), leg=info(2))
    assert not left_open(registry)
    assert len(registry.select(where())) == 2
    assert registry.put(OTHER, "rosie", "head", info(3))
    assert not left_open(registry)


def test_a_missed_announcement_shows_with_the_next_one(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    answer(registry, 1, arm=info())
    assert not registry.put(OTHER, "rosie", "head", info(3, "nod"))
    assert reported.changes[-1] == (["nod"], [], [])
    answer(registry, 3, arm=info(), leg=info(2, "kick"), head=info(3, "nod"))
    assert reported.changes[-1] == (["kick"], [], [])
    assert not left_open(registry)


def test_a_missed_withdrawal_shows_in_the_answer(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    answer(registry, 2, arm=info(), leg=info(2, "kick"))
    assert not registry.count(OTHER, 3)
    answer(registry, 3, arm=info())
    assert reported.changes[-1] == ([], ["kick"], [])
    assert registry.removed(ServiceKey(OTHER, "rosie", "leg", "kick"))


def test_services_behind_a_bridge_come_and_go_with_what_it_exports(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    answer(registry, 2, arm=info(), leg=info(2, "kick"))
    for revision in (2, 2, 3):
        assert registry.reopen(OTHER)
        assert left_open(registry)
        assert [record.name for record in registry.select(where())] == ["go", "kick"]  # until it replies
        answer(registry, revision, arm=info())
        assert reported.changes[-1] == ([], ["kick"], [])
        assert not left_open(registry)
        assert registry.reopen(OTHER)
        answer(registry, revision, arm=info(), leg=info(2, "kick"))
        assert reported.changes[-1] == (["kick"], [], [])
        assert not registry.removed(ServiceKey(OTHER, "rosie", "leg", "kick"))
    assert not registry.reopen(Address("arm", "unknown", "e1"))


def test_the_last_announcement_that_was_missed_shows_with_the_count(registry: Registry) -> None:
    registry.appear(OTHER)
    answer(registry, 1, arm=info())
    assert registry.count(OTHER, 1)
    assert not registry.count(OTHER, 2)
    assert left_open(registry)
    answer(registry, 2, arm=info(), leg=info(2))
    assert registry.count(OTHER, 2)


def test_an_answer_older_than_what_is_known_takes_nothing_back(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info(1))
    registry.put(OTHER, "rosie", "leg", info(2, "kick"))
    answer(registry, 1, arm=info(1))
    assert [record.name for record in registry.select(where())] == ["go", "kick"]
    assert not left_open(registry)
    answer(registry, 2, leg=info(2, "kick"))
    answer(registry, 1, arm=info(1))
    registry.put(OTHER, "rosie", "arm", info(1))
    assert [record.name for record in registry.select(where())] == ["kick"]


def test_an_answer_from_before_the_sign_of_life_fell_is_none(registry: Registry) -> None:
    registry.appear(OTHER)
    [before] = [state for state in registry.containers() if state.address == OTHER]
    registry.vanish(OTHER)
    registry.appear(OTHER)
    registry.settle(before, 1, {"arm": ("rosie", info())})
    assert registry.select(where()) == []
    assert left_open(registry)


def test_only_so_many_providers_of_one_container_count(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trade._registry.registry._MOST_PROVIDERS", 10)
    registry.appear(OTHER)
    for number in range(1, 100):
        registry.put(OTHER, "rosie", f"p{number}", info(number))
        registry.put(OTHER, "rosie", f"q{number}", gone(number))
    [state] = [state for state in registry.containers() if state.address == OTHER]
    assert (len(state.providers), len(state.removed)) == (10, 10)
    registry.put(OTHER, "rosie", "p1", info(1000, "still"))
    assert [record.name for record in registry.select(where(name="still"))] == ["still"]


@given(st.data())
def test_whatever_is_lost_the_answer_that_closes_everything_is_true(data: st.DataObject) -> None:
    """One container announces; each message may be lost, answers come late; nothing is open, so all is known."""
    registry, truth, revision = Registry(OWN), dict[str, ProviderInfo](), 0
    registry.appear(OTHER)
    late = list[tuple[int, dict[str, ProviderInfo]]]()
    names = iter(f"p{number}" for number in range(100))
    for act in data.draw(
        st.lists(st.sampled_from(["offer", "alter", "withdraw", "ask", "answer", "count", "reopen"]), max_size=30)
    ):
        if act == "ask":
            late.append((revision, dict(truth)))
        elif act == "answer" and late:
            revision_then, then = late.pop(0)
            answer(registry, revision_then, **then)
        elif act == "count":
            registry.count(OTHER, revision)
        elif act == "reopen":
            registry.reopen(OTHER)
        elif act == "offer" or (act in ("alter", "withdraw") and truth):
            revision += 1
            name = next(names) if act == "offer" else data.draw(st.sampled_from(sorted(truth)))
            entry = gone(revision) if act == "withdraw" else info(revision, f"r{revision}")
            truth.pop(name, None)
            if entry.services:
                truth[name] = entry
            if data.draw(st.booleans()):
                registry.put(OTHER, "rosie", name, entry)
    registry.count(OTHER, revision)
    if left_open(registry):
        answer(registry, revision, **truth)
    assert not left_open(registry)
    known = {record.key.provider: record.name for record in registry.select(where())}
    assert known == {name: entry.services[0].name for name, entry in truth.items()}


def test_a_new_revision_lists_what_came_what_went_and_what_stayed(registry: Registry, reported: Reports) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info(1, "a", "b"))
    registry.put(OTHER, "rosie", "arm", info(2, "b", "c", group="lab"))
    assert reported.changes[1] == (["c"], ["a"], ["b"])
    assert [record.groups for record in registry.select(where(name="b"))] == [("lab",)]


def test_an_older_revision_is_ignored(registry: Registry) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info(2, "new"))
    registry.put(OTHER, "rosie", "arm", info(1, "old"))
    assert [record.name for record in registry.select(where())] == ["new"]


def test_two_boots_of_one_container_are_two_containers(registry: Registry) -> None:
    again = Address(OTHER.identity, OTHER.container, "e2")
    for address in (OTHER, again):
        registry.appear(address)
        registry.put(address, "rosie", "arm", info())
    registry.vanish(OTHER)
    assert [record.key.address for record in registry.select(where())] == [again]


def test_a_service_that_stays_through_a_new_revision_is_never_missing(registry: Registry) -> None:
    registry.appear(OTHER)
    registry.put(OTHER, "rosie", "arm", info())
    key = ServiceKey(OTHER, "rosie", "arm", "go")
    missing, done = [], threading.Event()

    def look() -> None:
        while not done.is_set():
            if registry.get(key) is None:
                missing.append(True)

    looking = threading.Thread(target=look)
    looking.start()
    for revision in range(2, 2000):
        registry.put(OTHER, "rosie", "arm", info(revision))
    done.set()
    looking.join()
    assert missing == []


def test_nothing_is_kept_of_containers_that_have_ended(registry: Registry) -> None:
    for boot in range(1000):
        address = Address("arm", "short-lived", f"e{boot}")
        registry.appear(address)
        registry.put(address, "rosie", "arm", info())
        registry.vanish(address)
        registry.put(address, "rosie", "leg", info(2))
    assert [state.address for state in registry.containers()] == [OWN]


def test_waiting_ends_when_the_condition_holds_or_the_time_is_over(registry: Registry) -> None:
    assert not registry.wait_for(lambda: False, 0)
    coming = threading.Timer(0.02, lambda: registry.appear(OTHER))
    coming.start()
    assert registry.wait_for(lambda: registry.is_alive(OTHER), 20)
    coming.join()


_events = st.lists(
    st.tuples(
        st.sampled_from(["put", "remove", "answer", "appear", "vanish"]),
        st.sampled_from([OTHER, Address("arm", "driver", "e2")]),
        st.sampled_from(["arm", "leg"]),
        st.integers(1, 3),
    ),
    max_size=25,
)


@given(_events)
def test_reported_changes_add_up_to_the_present_services(events: list[tuple[str, Address, str, int]]) -> None:
    registry = Registry(OWN)
    reported: set[ServiceKey] = set()

    def hear(change: Change) -> None:
        joined, left = {record.key for record in change.joined}, {record.key for record in change.left}
        assert not joined & reported, "came twice"
        assert left <= reported, "left without having come"
        reported.update(joined)
        reported.difference_update(left)

    registry.changes.subscribe(hear)
    for event, address, provider, revision in events:
        match event:
            case "put":
                registry.put(address, "rosie", provider, info(revision, "a", f"b{revision}"))
            case "remove":
                registry.put(address, "rosie", provider, gone(revision))
            case "answer":
                for state in registry.containers():
                    if state.address == address:
                        registry.settle(state, revision, {provider: ("rosie", info(revision, "a"))})
            case "appear":
                registry.appear(address)
            case _:
                registry.vanish(address)
    assert reported == {record.key for record in registry.select(where())}
