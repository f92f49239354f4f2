"""The moment between being withdrawn here and being offered there: once at most, whatever is lost or dies then."""

import sys
import threading

import pytest

from tests.support.waiting import wait_until
from tests.unit.trade.moving_providers import Scene
from trade import Handle, where
from trade._migration import source as _departing
from trade.errors import CannotMigrate, LockedByOther, MigrationUnknown, ServiceGone


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_departing, "_ARRIVE_S", 0.5)
    monkeypatch.setattr(_departing, "_ASK_S", 0.5)


def offered(scene: Scene) -> list[str]:
    """The containers that offer it, as they know it themselves."""
    alive = [one for one in (scene.old, scene.new) if one.healthy()]
    return [one.name for one in alive if one.services(where.local & where(name="count"))]


def in_between(scene: Scene, fault: object) -> None:
    """Do something when it has been withdrawn and is not offered yet."""
    take_off = scene.old._parts.withdrawn_providers.take_off

    def and_then(*args: str, **options: str) -> str:
        name = take_off(*args, **options)
        fault()
        return name

    scene.old._parts.withdrawn_providers.take_off = and_then


def cut_calls(scene: Scene, *, source: str) -> None:
    """From now on what goes from one of the two to the other is lost, while both see each other."""
    kind = "call/" if source == "old" else "reply/"
    scene.memory.lose(lambda one: one.source == source and one.key.startswith(kind))


def moved_in_vain(scene: Scene, count: Handle) -> CannotMigrate:
    with pytest.raises(CannotMigrate) as error:
        scene.asker.migrate(count, to="new")
    return error.value


def test_what_the_other_side_refuses_to_offer_is_offered_here_again(scene: Scene) -> None:
    scene.policy()
    count, _ = scene.counter()
    in_between(scene, lambda: scene.new.load_policy(scene.policy(load=False, old="chief")))
    error = moved_in_vain(scene, count)
    assert error.withdrawn
    assert "old may not register" in str(error)
    assert "It is offered again where it was, under new handles" in str(error)
    scene.memory.settle()
    assert offered(scene) == ["old"]
    with pytest.raises(ServiceGone):
        count()
    assert scene.asker.call(where(name="count")) == 4
    assert [event for event in scene.module.events if event.startswith("close")] == ["close 3"]


def test_what_was_offered_there_has_moved_though_the_answer_was_lost(scene: Scene) -> None:
    count, _ = scene.counter()
    in_between(scene, lambda: cut_calls(scene, source="new"))
    [moved, _] = scene.asker.migrate(count, to="new")
    assert offered(scene) == ["new"]
    assert scene.module.events[-1] == "close 3"
    assert moved.container == "new"


def test_a_provider_stays_withdrawn_after_lost_contact_until_a_user_decides(scene: Scene) -> None:
    count, _ = scene.counter()
    in_between(scene, lambda: cut_calls(scene, source="old"))
    with pytest.raises(MigrationUnknown) as error:
        scene.asker.migrate(count, to="new")
    assert offered(scene) == []
    assert (error.value.container, error.value.to) == ("old", "new")
    assert f"trade.register '\"{error.value.withdrawn}\"' --container old" in str(error.value)
    scene.old.system.register(error.value.withdrawn)
    scene.memory.settle()
    assert scene.asker.call(where(name="count")) == 4


def test_a_death_before_the_offer_leaves_the_decision_to_a_user(scene: Scene) -> None:
    count, _ = scene.counter()
    in_between(scene, lambda: scene.memory.kill("new"))
    with pytest.raises((MigrationUnknown, CannotMigrate)) as error:
        scene.asker.migrate(count, to="new")
    if isinstance(error.value, MigrationUnknown):  # else it was clear that it had not been asked yet
        scene.old.system.register(error.value.withdrawn)
    scene.memory.settle()
    assert scene.asker.call(where(name="count")) == 4


def test_a_source_that_dies_before_the_offer_loses_the_provider_and_the_prepared_one_ends(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade._migration.target.TICKET_S", 0.2)
    count, _ = scene.counter()
    in_between(scene, lambda: scene.memory.kill("old"))
    run = scene.asker.find(where(name="migrate", container="old")).start(count, "new")
    assert run.exception(30) is not None
    wait_until(lambda: "close 3" in scene.module.events)
    scene.memory.settle()
    assert scene.asker.services(where(name="count")) == []


def test_a_call_that_was_let_in_too_late_does_not_run_on_what_is_left(scene: Scene) -> None:
    """It has found the service before that is withdrawn, and gets to it after."""
    count, _ = scene.counter()
    found = scene.old._parts.providers.service(count.key)
    here = scene.old.find(where(name="count"))
    target = scene.old._parts.targets.look_up(here)
    scene.asker.migrate(count, to="new")
    assert found is not None
    with pytest.raises(LockedByOther, match="migrating to container new"):
        target.call((), {}, 1.0)
    assert "count" not in scene.module.events


def test_what_its_owner_registers_again_serves_again(scene: Scene) -> None:
    provider = scene.module.Counter()
    count = scene.offer(provider)["count"]
    scene.asker.migrate(count, to="new")
    [again, _] = scene.old.register(provider, "hall")
    assert again() == 1


def test_calls_while_it_moves_back_and_forth_are_each_counted_once(scene: Scene) -> None:
    """By the object's own count: what was answered is in the state that moves on."""
    scene.counter()
    answered: list[int] = []
    over = threading.Event()

    def call() -> None:
        while not over.is_set():
            try:
                answered.append(scene.new.call(where(name="count")))
            except (LookupError, LockedByOther):
                continue

    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads change places wherever they can
    caller = threading.Thread(target=call)
    caller.start()
    try:
        for to in ("new", "old") * 20:
            wait_until(lambda: scene.asker.services(where(name="count")))
            seen = len(answered)
            wait_until(lambda seen=seen: len(answered) > seen)
            scene.asker.migrate(where(name="count"), to=to)
            scene.memory.settle()
    finally:
        sys.setswitchinterval(interval_s)
        over.set()
        caller.join(30)
    assert answered == list(range(4, 4 + len(answered)))
